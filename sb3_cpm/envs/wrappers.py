"""Small wrappers that make other environments fit the challenger-player method."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class DictObservation(gym.Wrapper):
    """
    Turn a Box observation into a Dict with one key, which is what ``CPMBuffer`` works with.

    >>> env = DictObservation(gym.make("Pendulum-v1"))
    >>> env.observation_space["state"].shape
    (3,)

    :param env: an environment whose observation space is a Box
    :param key: the name that the observation gets
    :raises ValueError: when the observation space is not a Box
    """

    def __init__(self, env: gym.Env, key: str = "state") -> None:
        super().__init__(env)
        if not isinstance(env.observation_space, spaces.Box):
            cure = "it needs no wrapper" if isinstance(env.observation_space, spaces.Dict) else "make it a Box or a Dict first"
            raise ValueError(f"DictObservation takes a Box observation space, not {env.observation_space}: {cure}.")
        self.key = key
        self.observation_space = spaces.Dict({key: env.observation_space})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        return {self.key: observation}, info

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return {self.key: observation}, reward, terminated, truncated, info
