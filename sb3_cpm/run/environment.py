"""Environments of a run, by name."""

import signal
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.envs.wrappers import DictObservation


def make_env(env_id: str, render_mode: str | None = None, **kwargs: Any) -> gym.Env:
    """
    Make an environment with a Dict observation space.

    :param env_id: a gymnasium id, or else the name of a ManiSkill task
    :param render_mode: ``"rgb_array"`` for videos; left away where the environment cannot
    :param kwargs: arguments of the environment
    :return: the environment; a Box observation becomes a Dict with the key ``"state"``
    :raises ValueError: for an unknown name, or spaces that the method cannot use
    """
    if is_maniskill(env_id):
        from sb3_cpm.envs import make_maniskill_env

        return make_maniskill_env(env_id, render_mode=render_mode, **kwargs)
    modes = _render_modes(env_id)
    env = gym.make(env_id, render_mode=render_mode if render_mode in modes else None, **kwargs)
    if not isinstance(env.action_space, spaces.Box):
        raise ValueError(f"{env_id} has the action space {env.action_space}: the player and the challenger need a Box.")
    if isinstance(env.observation_space, spaces.Box):
        env = DictObservation(env)
    if not isinstance(env.observation_space, spaces.Dict):
        raise ValueError(f"{env_id} has the observation space {env.observation_space}: expected a Dict or a Box.")
    return env


def make_vec_env(env_id: str, n_envs: int, seed: int, **kwargs: Any) -> VecEnv:
    """
    Environments for training, each with a ``Monitor``; more than one run in processes of their own. One that dies is replaced,
    its episode truncated: a simulator's crash after days costs an episode and not the run.

    :param env_id: see :func:`make_env`
    :param n_envs: how many
    :param seed: environment ``i`` starts with ``seed + i``
    :param kwargs: arguments of the environment
    """

    def maker(rank: int) -> Callable[[], gym.Env]:
        def make() -> gym.Env:
            if n_envs > 1:  # in a process of its own
                set_random_seed(seed + rank)
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main one ends this one
            env = Monitor(make_env(env_id, **kwargs))
            env.action_space.seed(seed + rank)
            return env

        return make

    makers = [maker(rank) for rank in range(n_envs)]
    env: VecEnv = DummyVecEnv(makers) if n_envs == 1 else RobustSubprocVecEnv(makers)
    env.seed(seed)
    return env


def max_episode_steps(env: VecEnv) -> int | None:
    """:return: the time limit of the environments, None where there is none"""
    limits = [spec.max_episode_steps for spec in env.get_attr("spec") if spec is not None]
    known = [limit for limit in limits if limit is not None]
    return max(known) if known else None


def is_maniskill(env_id: str) -> bool:
    """Is this no gymnasium id, or one that ManiSkill has registered (with a function of its own)?"""
    spec = gym.registry.get(env_id)
    if spec is None:
        return ":" not in env_id
    return getattr(getattr(spec.entry_point, "func", None), "__module__", "").startswith("mani_skill")


def _render_modes(env_id: str) -> list[str]:
    entry_point = gym.spec(env_id).entry_point
    creator = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return getattr(creator, "metadata", {}).get("render_modes", [])
