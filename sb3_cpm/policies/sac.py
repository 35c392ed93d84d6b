"""Policies for SAC: ``SAC(LayerNormPolicy, env)``, for vectors, images, and Dicts of them and of point clouds."""

from sb3_cpm.extractors import PointNetPolicy
from sb3_cpm.policies.shapes import LayerNormMixin, SimbaMixin


class LayerNormPolicy(LayerNormMixin, PointNetPolicy):
    __doc__ = LayerNormMixin.__doc__


class SimbaPolicy(SimbaMixin, PointNetPolicy):
    __doc__ = SimbaMixin.__doc__
