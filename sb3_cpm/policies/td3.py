"""The same for TD3 and DDPG: ``TD3(sb3_cpm.policies.td3.LayerNormPolicy, env)``."""

from stable_baselines3.td3.policies import TD3Policy

from sb3_cpm.policies.shapes import LayerNormMixin, SimbaMixin


class LayerNormPolicy(LayerNormMixin, TD3Policy):
    __doc__ = LayerNormMixin.__doc__


class SimbaPolicy(SimbaMixin, TD3Policy):
    __doc__ = SimbaMixin.__doc__
