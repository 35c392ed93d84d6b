"""How SB3's actors and critics get other networks: made by SB3, then given another trunk before their optimizers are made."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
    create_mlp,
)
from torch import nn

from sb3_cpm.extractors import PointNetExtractor
from sb3_cpm.policies.networks import Simba
from sb3_cpm.spaces import looks_like_cloud


def extractor_for(space: spaces.Space) -> type[BaseFeaturesExtractor]:
    """:return: what SB3 takes for such observations, and for Dicts with point clouds :class:`PointNetExtractor`"""
    if isinstance(space, spaces.Dict):
        return PointNetExtractor if any(map(looks_like_cloud, space.spaces.values())) else CombinedExtractor
    return NatureCNN if is_image_space(space) else FlattenExtractor


class _Shaped(BasePolicy):
    """
    A mixin in front of a policy of SB3 or sb3-contrib with ``latent_pi`` (SAC, TQC) or ``mu`` (TD3, DDPG) in its actor and
    ``q_networks`` in its critic.

    :param observation_space: vectors, images, or a Dict of them and of clouds
    :param action_space: Box space
    :param lr_schedule: learning rate schedule
    :param features_extractor_class: None: what suits the observations, see :func:`extractor_for`
    :param kwargs: further arguments of the policy
    """

    action_space: spaces.Box
    critic_kwargs: dict[str, Any]
    activation_fn: type[nn.Module]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Any,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        **kwargs: Any,
    ) -> None:
        extractor = features_extractor_class or extractor_for(observation_space)
        super().__init__(observation_space, action_space, lr_schedule, features_extractor_class=extractor, **kwargs)

    def actor_trunk(self, n_features: int, net_arch: list[int]) -> nn.Module:
        """:return: features to the last hidden layer"""
        raise NotImplementedError

    def q_network(self, n_features: int, n_inputs: int, n_outputs: int, net_arch: list[int]) -> nn.Module:
        """:return: features and action to values"""
        raise NotImplementedError

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        actor = super().make_actor(features_extractor)  # type: ignore[misc]
        trunk = self.actor_trunk(actor.features_dim, actor.net_arch)
        if hasattr(actor, "latent_pi"):
            actor.latent_pi = trunk.to(self.device)
        else:
            mean = nn.Linear(actor.net_arch[-1], get_action_dim(self.action_space))
            actor.mu = nn.Sequential(trunk, mean, nn.Tanh()).to(self.device)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        critic = super().make_critic(features_extractor)  # type: ignore[misc]
        n_features, n_outputs = critic.features_extractor.features_dim, getattr(critic, "n_quantiles", 1)
        n_inputs = n_features + get_action_dim(self.action_space)
        net_arch = self.critic_kwargs["net_arch"]
        for i in range(critic.n_critics):
            critic.q_networks[i] = self.q_network(n_features, n_inputs, n_outputs, net_arch).to(self.device)
            setattr(critic, f"qf{i}", critic.q_networks[i])
        return critic


class LayerNormMixin(_Shaped):
    """
    Layer normalisation before each activation (Ball et al. 2023, section 4.2: it bounds what a critic says of actions that it
    has not seen).

    :param observation_space: vectors, images, or a Dict of them and of clouds
    :param action_space: Box space
    :param lr_schedule: learning rate schedule
    :param actor_layer_norm: in the actor, too
    :param kwargs: further arguments of the policy
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Any,
        actor_layer_norm: bool = True,
        **kwargs: Any,
    ) -> None:
        self.actor_layer_norm = actor_layer_norm
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    def actor_trunk(self, n_features: int, net_arch: list[int]) -> nn.Module:
        return self._mlp(n_features, -1, net_arch, self.actor_layer_norm)

    def q_network(self, n_features: int, n_inputs: int, n_outputs: int, net_arch: list[int]) -> nn.Module:
        return self._mlp(n_inputs, n_outputs, net_arch, True)

    def _mlp(self, n_inputs: int, n_outputs: int, net_arch: list[int], layer_norm: bool) -> nn.Module:
        norm: list[type[nn.Module]] = [nn.LayerNorm] if layer_norm else []
        return nn.Sequential(*create_mlp(n_inputs, n_outputs, net_arch, self.activation_fn, post_linear_modules=norm))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "actor_layer_norm": self.actor_layer_norm}


class SimbaMixin(_Shaped):
    """
    SimBa (Lee et al. 2024): observations standardised by running statistics, residual blocks with layer normalisation, weight
    decay. The numbers of ``net_arch`` are the widths of the blocks, all alike within a network.

    :param observation_space: vectors, images, or a Dict of them and of clouds; what is standardised are the extractor's
        features
    :param action_space: Box space
    :param lr_schedule: learning rate schedule; the paper has 1e-4
    :param net_arch: blocks of actor and critic; None: one of 128 and two of 512, as the paper
    :param optimizer_class: AdamW with a weight decay of 0.01 unless told otherwise, as the paper
    :param optimizer_kwargs: of the optimizer
    :param kwargs: further arguments of the policy
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Any,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if optimizer_kwargs is None and optimizer_class is th.optim.AdamW:
            optimizer_kwargs = {"weight_decay": 0.01}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": [128], "qf": [512, 512]} if net_arch is None else net_arch,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    def actor_trunk(self, n_features: int, net_arch: list[int]) -> nn.Module:
        return Simba(n_features, n_features, net_arch)

    def q_network(self, n_features: int, n_inputs: int, n_outputs: int, net_arch: list[int]) -> nn.Module:
        trunk = Simba(n_features, n_inputs, net_arch)
        return nn.Sequential(trunk, nn.Linear(net_arch[-1], n_outputs))
