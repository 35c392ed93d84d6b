"""
RLPD (Ball et al. 2023) as a policy of stock SAC: ten critics with layer normalisation, a random pair of which gives the
target.

The rest of it are settings that SB3 and :class:`~sb3_cpm.buffers.CPMBuffer` have: half of each batch from demonstrations
(``challenge_ratio=0, mix="row", demonstration_ratio=0.5``), and many updates per step (``gradient_steps``).
"""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_cpm.arguments import check, integer
from sb3_cpm.extractors import FrugalCritic, PointNetPolicy
from sb3_cpm.policies.networks import MLPs
from sb3_cpm.policies.shapes import extractor_for


class RLPDCritic(FrugalCritic):
    """
    Many critics computed as one. What they say depends on who asks, as SB3's SAC takes the minimum of whatever it gets:

    * without gradients (SAC's target): ``n_min`` of them, drawn anew each time, of which SAC takes the minimum;
    * where the actions carry a gradient (the actor's loss): the mean of all, one tensor;
    * otherwise (their own loss): all.

    :param n_critics: how many
    :param n_min: how many of them make the target
    :param layer_norm: normalise their hidden layers
    :param net_arch: sizes of these
    :param activation_fn: after these
    :param kwargs: further arguments of SB3's ``ContinuousCritic``
    """

    def __init__(
        self,
        n_critics: int,
        n_min: int,
        layer_norm: bool,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        **kwargs: Any,
    ) -> None:
        super().__init__(n_critics=0, net_arch=net_arch, activation_fn=activation_fn, **kwargs)
        n_inputs = self.features_extractor.features_dim + get_action_dim(self.action_space)
        self.n_critics, self.n_min = n_critics, n_min
        self.networks = MLPs(n_critics, n_inputs, net_arch, activation_fn, layer_norm)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param obs: shape ``(batch, *obs_shape)``
        :param actions: shape ``(batch, action_dim)``
        :return: values, each of shape ``(batch, 1)``
        """
        inputs = th.cat((self.features(obs, actions), actions), dim=1)
        if not th.is_grad_enabled():
            return self.networks(inputs, th.randperm(self.n_critics, device=inputs.device)[: self.n_min]).unbind(0)
        if actions.requires_grad:  # SAC clears what the actor's loss leaves in the critics, so it need not be computed
            return (self.networks(inputs, frozen=True).mean(0),)
        return self.networks(inputs).unbind(0)


class RLPDPolicy(PointNetPolicy):
    """
    :param observation_space: vectors, images, or a Dict of them and of clouds
    :param action_space: Box space
    :param lr_schedule: learning rate schedule
    :param n_critics: number of critics [10]
    :param n_min: number of them, drawn for each update, of which the target takes the minimum [2; 1 on some of the tasks]
    :param critic_layer_norm: normalise the critics' hidden layers [yes]
    :param features_extractor_class: None: what suits the observations
    :param kwargs: further arguments of SAC's policies
    :raises ValueError: for an ``n_min`` that is not within ``n_critics``
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Any,
        n_critics: int = 10,
        n_min: int = 2,
        critic_layer_norm: bool = True,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        **kwargs: Any,
    ) -> None:
        check("n_critics", n_critics, integer(1))
        check("n_min", n_min, integer(1))
        if n_min > n_critics:
            raise ValueError(f"n_min={n_min} critics cannot be drawn of n_critics={n_critics}: it is at most that.")
        self.n_min, self.critic_layer_norm = n_min, critic_layer_norm
        extractor = features_extractor_class or extractor_for(observation_space)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=extractor,
            n_critics=n_critics,
            **kwargs,
        )

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> RLPDCritic:
        kwargs = {**self.critic_kwargs, "n_min": self.n_min, "layer_norm": self.critic_layer_norm}
        return RLPDCritic(**self._update_features_extractor(kwargs, features_extractor)).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        ours = {"n_min": self.n_min, "critic_layer_norm": self.critic_layer_norm}
        return {**super()._get_constructor_parameters(), **ours}
