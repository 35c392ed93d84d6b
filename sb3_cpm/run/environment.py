"""Environments of a run, by name."""

import contextlib
import importlib
import inspect
import signal
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.arguments import nearest
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.envs.suites import register_suite
from sb3_cpm.envs.wrappers import DictObservation
from sb3_cpm.run.arguments import unexpected_argument


def make_env(env_id: str, render_mode: str | None = None, **kwargs: Any) -> gym.Env:
    """
    Make an environment with a Dict observation space.

    :param env_id: a gymnasium id, or else the name of a ManiSkill task; ``MODULE:ID`` imports first what registers it
    :param render_mode: ``"rgb_array"`` for videos; left away where the environment cannot
    :param kwargs: arguments of the environment
    :return: the environment; a Box observation becomes a Dict with the key ``"state"``
    :raises ValueError: for an unknown name or argument, or spaces that the method cannot use
    """
    env_id = registered(env_id)
    with _arguments_explained(env_id, kwargs):
        return _make_env(env_id, render_mode, **kwargs)


def _make_env(env_id: str, render_mode: str | None, **kwargs: Any) -> gym.Env:
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


def registered(env_id: str) -> str:
    """
    >>> registered("sb3_cpm.envs.toy:CPMToy-v0")
    'CPMToy-v0'

    :param env_id: an id, or ``MODULE:ID`` for one that this module registers when it is imported
    :return: the id alone
    :raises ValueError: if there is no such module, or it does not register that
    """
    module, colon, name = env_id.rpartition(":")
    if not colon:
        register_suite(env_id)
        return env_id
    try:
        importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise ValueError(f"env={env_id!r}: cannot import {module!r}, which should register {name!r} ({error})") from error
    if name not in gym.registry:
        raise ValueError(f"env={env_id!r}: {module} registers no {name!r}.{nearest(name, gym.registry)}")
    return name


@contextlib.contextmanager
def _arguments_explained(env_id: str, kwargs: dict[str, Any]) -> Iterator[None]:
    """An argument that the environment does not take is a slip of whoever started the run; other errors are not."""
    try:
        yield
    except TypeError as error:
        unknown = unexpected_argument(error)
        if unknown is None or unknown not in kwargs:
            raise
        entry_point = "sb3_cpm.envs:make_maniskill_env" if is_maniskill(env_id) else gym.spec(env_id).entry_point
        taker = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
        valid = [] if taker is None else sorted(set(inspect.signature(taker).parameters) - {"env_id", "task_kwargs"})
        told = f" Valid: {', '.join(valid)}." if valid else ""
        raise ValueError(f"env_kwargs: {env_id} takes no {unknown!r}.{nearest(unknown, valid)}{told}") from error


def is_maniskill(env_id: str) -> bool:
    """Is this no gymnasium id, or one that ManiSkill has registered (with a function of its own)?"""
    spec = gym.registry.get(env_id)
    if spec is None:
        return True
    return getattr(getattr(spec.entry_point, "func", None), "__module__", "").startswith("mani_skill")


def _render_modes(env_id: str) -> list[str]:
    entry_point = gym.spec(env_id).entry_point
    creator = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return getattr(creator, "metadata", {}).get("render_modes", [])
