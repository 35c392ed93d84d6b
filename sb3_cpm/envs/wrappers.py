"""Small wrappers that make other environments fit the challenger-player method."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv


def check_single(env: Any, wrapper: str) -> None:
    """:raises ValueError: unless ``env`` is a gymnasium environment, which this wrapper can be put around"""
    if isinstance(env, gym.Env):
        return
    what = f"{wrapper} is put around one gymnasium environment, not around {env!r:.80}"
    if isinstance(env, (VecEnv, gym.vector.VectorEnv)):
        raise ValueError(
            f"{what}, which holds several: wrap each before they are put together, make_vec_env(env_id, n_envs=..., "
            f"wrapper_class={wrapper}) or DummyVecEnv([lambda: {wrapper}(gym.make(env_id))])."
        )
    cure = f"make it first, {wrapper}(gym.make({env!r}))" if isinstance(env, str) else "make one first, with gymnasium.make()"
    raise ValueError(f"{what}: {cure}.")


class DictObservation(gym.Wrapper):
    """
    Turn a Box observation into a Dict with one key, which is what ``CPMBuffer`` works with.

    >>> env = DictObservation(gym.make("Pendulum-v1"))
    >>> env.observation_space["state"].shape
    (3,)

    :param env: an environment whose observation space is a Box
    :param key: the name that the observation gets
    :raises ValueError: when the observation space is not a Box, or it is not a single environment
    """

    def __init__(self, env: gym.Env, key: str = "state") -> None:
        check_single(env, type(self).__name__)
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
