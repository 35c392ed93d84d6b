"""The same for TQC of sb3-contrib: ``TQC(sb3_cpm.policies.tqc.LayerNormPolicy, env)``."""

from sb3_cpm.extras import needed
from sb3_cpm.policies.shapes import LayerNormMixin, SimbaMixin

with needed("Policies for TQC", "contrib"):
    from sb3_contrib.tqc.policies import TQCPolicy


class LayerNormPolicy(LayerNormMixin, TQCPolicy):
    __doc__ = LayerNormMixin.__doc__


class SimbaPolicy(SimbaMixin, TQCPolicy):
    __doc__ = SimbaMixin.__doc__
