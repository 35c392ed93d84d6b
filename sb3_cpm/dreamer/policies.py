"""
The challenger as an SB3 policy: what acts, with the latent state as the recurrent state of ``predict``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, maybe_transpose
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import is_vectorized_observation
from typing_extensions import Self

from sb3_cpm.challenger import Challenger
from sb3_cpm.dreamer.spaces import OBSERVATION, as_dict, as_dict_space
from sb3_cpm.presets import PresetLike
from sb3_cpm.uncertainty.base import Uncertainty
from sb3_cpm.world_model.observations import to_tensor
from sb3_cpm.world_model.rssm import LatentState

#: Recurrent state of ``predict``: deterministic and stochastic part of the latent state, shapes ``(n_envs, size)``, and the
#: action, within [-1, 1], that was taken in it, shape ``(n_envs, action_dim)``.
RecurrentState = tuple[np.ndarray, ...]


class DreamerPolicy(BasePolicy):
    """
    Policy of :class:`~sb3_cpm.dreamer.Dreamer` and :class:`~sb3_cpm.dreamer.Plan2Explore`, for images, vectors and Dicts of
    them alike.

    :param observation_space: a Dict, or a Box that is an image or a vector
    :param action_space: bounded Box
    :param lr_schedule: not needed here, SB3 passes it to every policy
    :param preset: sizes and constants, a name or a dict of entries that differ, see :mod:`sb3_cpm.presets`
    :param keys: keys of a Dict observation to read; all images and vectors by default
    :param uncertainty_class: who says what is new, a name or a class, see :class:`~sb3_cpm.challenger.Challenger`
    :param uncertainty_kwargs: arguments for it, on top of the preset's
    :param behavior: which of its behaviours acts, "task" or "exploration"
    :param device: PyTorch device
    :raises ValueError: for spaces that it cannot work with, unknown preset entries, a behaviour that the preset leaves out
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule | None = None,
        preset: PresetLike = "default",
        keys: Sequence[str] | None = None,
        uncertainty_class: str | type[Uncertainty] = "plan2explore",
        uncertainty_kwargs: Mapping[str, Any] | None = None,
        behavior: str = "task",
        device: th.device | str = "auto",
    ):
        super().__init__(observation_space, action_space, squash_output=True)
        self.behavior = behavior
        self.arguments: dict[str, Any] = {
            "preset": preset,
            "keys": keys,
            "uncertainty_class": uncertainty_class,
            "uncertainty_kwargs": uncertainty_kwargs,
        }
        self.challenger = Challenger(as_dict_space(observation_space), action_space, device, **self.arguments)
        if behavior not in self.challenger.behaviors:
            raise ValueError(
                f"The preset has the behaviours {list(self.challenger.behaviors)}, not {behavior!r}, which is to act: set its "
                f"entry 'train_{behavior}_behavior' to True."
            )
        self.networks = th.nn.ModuleDict(self.challenger.networks)
        # by these names SB3 saves and loads them
        for name, optimizer in self.challenger.optimizers.items():
            setattr(self, f"{name}_optimizer", optimizer.adam)

    @property
    def optimizer_names(self) -> list[str]:
        """Attributes that hold optimizers."""
        return [f"{name}_optimizer" for name in self.challenger.optimizers]

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """As ``torch.nn.Module.to``; what it is given to read goes there, too."""
        moved = super().to(*args, **kwargs)
        self.challenger.device = self.device
        return moved

    def get_extra_state(self) -> th.Tensor:
        """Part of ``state_dict()``: the number of updates."""
        return th.tensor(self.challenger.trained_updates)

    def set_extra_state(self, state: th.Tensor) -> None:
        self.challenger.trained_updates = int(state)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "behavior": self.behavior,
            **self.arguments,
        }

    # ---- acting ------------------------------------------------------------------------------------------------------

    def initial_state(self, n_envs: int = 1) -> RecurrentState:
        """
        The recurrent state before an episode: zeros.

        :param n_envs: number of environments
        """
        latent = self.challenger.initial_state(n_envs)
        nothing = np.zeros((n_envs, self.challenger.action_dim), dtype=np.float32)
        return latent.deter.cpu().numpy(), latent.stoch.cpu().numpy(), nothing

    def follow(
        self,
        observations: np.ndarray | Mapping[str, np.ndarray],
        state: RecurrentState,
        episode_start: np.ndarray,
        deterministic: bool = False,
    ) -> LatentState:
        """
        The latent state after an observation.

        :param observations: one per environment, of the space's shape
        :param state: the recurrent state before it
        :param episode_start: the observation is the first of its episode, shape ``(n_envs,)``, bool
        :param deterministic: modes instead of samples
        """
        deter, stoch, action = state
        # the distribution that `stoch` was drawn from plays no part in what follows
        latent = LatentState(*(to_tensor(part, self.challenger.device) for part in (deter, stoch, stoch)))
        row = {key: np.asarray(value)[None] for key, value in as_dict(observations).items()}
        return self.challenger.follow(latent, row, action[None], episode_start[None], deterministic=deterministic)

    def act(self, latent: LatentState, deterministic: bool = False, noise: th.Tensor | None = None) -> np.ndarray:
        """
        :param latent: as :meth:`follow` gives it
        :param deterministic: the mode instead of a sample
        :param noise: see :meth:`Challenger.act <sb3_cpm.challenger.Challenger.act>`
        :return: actions within [-1, 1], shape ``(n_envs, action_dim)``
        """
        return self.challenger.act(latent, deterministic, self.behavior, noise)

    @staticmethod
    def recurrent_state(latent: LatentState, action: np.ndarray) -> RecurrentState:
        """
        :param latent: the state that was acted in
        :param action: the action that was executed, within [-1, 1], shape ``(n_envs, action_dim)``
        """
        return latent.deter.cpu().numpy(), latent.stoch.cpu().numpy(), np.asarray(action, dtype=np.float32)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for one or several environments, in the manner of SB3's recurrent policies: pass the state that the last call
        returned, and say where an episode has begun since.

        :param observation: of the space's shape, or one per environment; of a Dict only the keys that are read must be there
        :param state: what the last call returned; None forgets everything before
        :param episode_start: where True, the environment's episode starts with this observation and its state is not used
        :param deterministic: modes instead of samples, of actions and latent state
        :return: actions in the environment's units, and the state for the next call
        :raises ValueError: for observations of other shapes, or a state of another number of environments
        """
        self.set_training_mode(False)
        batch, vectorized = self._batch(observation)
        n_envs = len(next(iter(batch.values())))
        starts = np.zeros(n_envs, dtype=bool)
        if state is None:
            state, starts[:] = self.initial_state(n_envs), True
        if len(state) != 3 or any(len(part) != n_envs for part in state):
            shapes = [np.shape(part) for part in state]
            raise ValueError(
                f"`state` is of the shapes {shapes}, the observations are of {n_envs} environment(s): pass what the last call "
                "of predict() returned, or None."
            )
        if episode_start is not None:
            starts |= np.broadcast_to(np.asarray(episode_start, dtype=bool), n_envs)
        latent = self.follow(batch, state, starts, deterministic)
        scaled = self.act(latent, deterministic)
        assert isinstance(self.action_space, spaces.Box)
        low, high = self.action_space.low, self.action_space.high
        actions = np.clip(self.unscale_action(scaled.reshape(-1, *self.action_space.shape)), low, high)  # rounding
        return (actions if vectorized else actions[0]), self.recurrent_state(latent, scaled)

    def _batch(self, observation: np.ndarray | Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], bool]:
        """:return: what is read of the observations of several environments, and whether there were several"""
        if isinstance(observation, tuple):
            raise ValueError(
                "predict() was given a tuple: gymnasium's `env.reset()` returns (observation, info), pass the observation."
            )
        if isinstance(observation, Mapping) != isinstance(self.observation_space, spaces.Dict):
            raise ValueError(f"Got an observation of type {type(observation).__name__} for {self.observation_space}.")
        given = as_dict(observation)
        batch, vectorized = {}, False
        for key, space in as_dict_space(self.observation_space).items():
            if key not in self.challenger.keys:
                continue
            if key not in given:
                raise ValueError(f"Observation key {key!r} is missing, got {sorted(given)}.")
            value = np.ascontiguousarray(given[key])
            if is_image_space(space):
                value = maybe_transpose(value, space)
            vectorized = is_vectorized_observation(value, space)
            batch[key] = value if vectorized else value[None]
        return batch, vectorized

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions within [-1, 1] for first observations of episodes: without memory there is nothing else to go by."""
        tensors = observation if isinstance(observation, dict) else {OBSERVATION: observation}
        n_envs = len(next(iter(tensors.values())))
        row = {key: value.unsqueeze(0) for key, value in tensors.items()}
        nothing = np.zeros((1, n_envs, self.challenger.action_dim), dtype=np.float32)
        first = np.ones((1, n_envs), dtype=bool)
        start = self.challenger.initial_state(n_envs)
        latent = self.challenger.follow(start, row, nothing, first, deterministic=deterministic)
        return th.as_tensor(self.act(latent, deterministic), device=self.device)


MlpPolicy = CnnPolicy = MultiInputPolicy = DreamerPolicy
