"""
Policies for stock SAC whose critics do not believe in what they have not seen: with layer normalisation, SimBa's residual
networks, RLPD's ensemble. :mod:`sb3_cpm.policies.tqc` has the first two for TQC, :mod:`sb3_cpm.policies.td3` for TD3 and DDPG.
"""

from sb3_cpm.policies.rlpd import RLPDPolicy
from sb3_cpm.policies.sac import LayerNormPolicy, SimbaPolicy

__all__ = ["LayerNormPolicy", "RLPDPolicy", "SimbaPolicy"]
