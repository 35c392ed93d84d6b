"""
SAC with pink noise (Eberhard et al. 2023), a strong opponent in one line of a configuration: ``policy:
sb3_cpm.zoo.pink_noise.PinkNoisePolicy``.
"""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_cpm.extras import check_installed


class PinkNoiseActor(Actor):
    """
    Actions that are tried are sampled with pink noise, temporally correlated, in place of white noise. Deterministic ones, and
    those that the actor learns from, are as ever: pink-noise-rl's own distribution would give a whole batch one sample.

    :param noise_length: steps that a noise signal lasts, the length of an episode
    :raises MissingExtra: if pink-noise-rl is missing
    """

    def __init__(self, *args: Any, noise_length: int = 1000, **kwargs: Any) -> None:
        check_installed("Policies with pink noise", ("pink",), "experiments")
        super().__init__(*args, **kwargs)
        self.noise_length = noise_length
        self._noises: list[Any] = []  # one for each environment

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if deterministic:
            return super().forward(obs, deterministic)
        from pink import PinkNoiseProcess

        mean, log_std, _ = self.get_action_dist_params(obs)
        while len(self._noises) < len(mean):
            seed = np.random.randint(2**31)  # SB3 seeds NumPy's global generator
            self._noises.append(PinkNoiseProcess((mean.shape[-1], self.noise_length), rng=np.random.default_rng(seed)))
        noise = np.stack([process.sample() for process in self._noises[: len(mean)]])
        return th.tanh(mean + log_std.exp() * th.as_tensor(noise, dtype=mean.dtype, device=mean.device))


class PinkNoisePolicy(SACPolicy):
    """
    SAC's MlpPolicy with :class:`PinkNoiseActor`.

    :param noise_length: see there
    """

    def __init__(self, *args: Any, noise_length: int = 1000, **kwargs: Any) -> None:
        self.noise_length = noise_length
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: Any = None) -> PinkNoiseActor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return PinkNoiseActor(noise_length=self.noise_length, **actor_kwargs).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "noise_length": self.noise_length}
