"""Wrappers that configuration files name."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_cpm.envs import DictObservation
from sb3_cpm.envs.wrappers import check_single


class TerminationIsSuccess(gym.Wrapper[Any, Any, Any, Any]):
    """
    Say ``is_success`` where an environment only says so by ending the episode, such as MountainCarContinuous-v0.

    :param env: the environment; its ``terminated`` must mean success
    :raises ValueError: if it is not a single environment
    """

    def __init__(self, env: gym.Env) -> None:
        check_single(env, type(self).__name__)
        super().__init__(env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": bool(terminated)}


def as_dict(env: gym.Env) -> gym.Env:
    """
    A Box observation becomes a Dict with the key ``state``, a Dict stays what it is: for entries that fit any environment.

    :param env: the environment
    """
    check_single(env, "as_dict")
    return DictObservation(env) if isinstance(env.observation_space, spaces.Box) else env


class RGBD(gym.ObservationWrapper[Any, Any, Any]):
    """
    Depth as the fourth channel of every camera's picture of a ManiSkill task, 0 to ``max_depth`` metres as 0 to 255: to SB3
    and to the world model it is a picture like any other. From the same render, so it costs nothing to speak of.

    :param env: made by :func:`~sb3_cpm.envs.make_maniskill_env`, with cameras
    :param max_depth: metres; what is farther away gets 255
    :raises ValueError: if the environment is not of that kind
    """

    def __init__(self, env: gym.Env, max_depth: float = 2.0) -> None:
        check_single(env, type(self).__name__)
        super().__init__(env)
        self.batch: Any = env.get_wrapper_attr("batch") if env.has_wrapper_attr("batch") else None
        if self.batch is None or not self.batch.cameras:
            raise ValueError(f"RGBD needs a task of make_maniskill_env with cameras (obs_mode='visual'), got {env}.")
        if not max_depth > 0:
            raise ValueError(f"max_depth={max_depth}: expected more than 0 metres")
        self.max_depth = max_depth
        assert isinstance(env.observation_space, spaces.Dict)
        self.observation_space = spaces.Dict(
            {key: self._deeper(space) if key in self.batch.cameras else space for key, space in env.observation_space.items()}
        )

    @staticmethod
    def _deeper(space: spaces.Space) -> spaces.Box:
        height, width, channels = space.shape  # type: ignore[misc]
        return spaces.Box(0, 255, (height, width, channels + 1), np.uint8)

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        sensors = self.batch.env._last_obs["sensor_data"]
        seen = dict(observation)
        for camera in self.batch.cameras:
            # millimetres in the camera's frame, which looks along -z; int16 wraps around beyond 32 m, and 0 is nothing hit
            distance = -np.asarray(sensors[camera]["position"][0, ..., 2:].cpu(), dtype=np.float32) / 1000
            nowhere = distance <= 0
            depth = np.where(nowhere, 255, np.clip(distance / self.max_depth, 0, 1) * 255).astype(np.uint8)
            seen[camera] = np.concatenate([observation[camera], depth], axis=-1)
        return seen
