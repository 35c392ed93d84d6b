"""Demonstrations from wherever they are."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cpm.arguments import check, integer
from sb3_cpm.buffers import Demonstration
from sb3_cpm.buffers.demonstrations import read_demonstrations
from sb3_cpm.dreamer.spaces import as_dict_space
from sb3_cpm.imitation.recording import record_demonstrations

#: ``source`` for the environment's own expert.
EXPERT = "expert"

Source = str | Path | Demonstration | Sequence[Any]


def load_demonstrations(
    source: Source, env: VecEnv | gym.Env, n_episodes: int | None = None, seed: int | None = None, hold: bool = False
) -> list[Demonstration]:
    """
    :param source: ``"expert"``, the environment's own (:func:`record_demonstrations`); the path of a file of ManiSkill
        (``.h5``); demonstrations; or a list of these
    :param env: the training environments; where recorded actions have to be replayed, a single one, as made for training
    :param n_episodes: how many; None: all that the source has. An expert must be told
    :param seed: for an expert
    :param hold: for an expert
    :return: the demonstrations, the first ``n_episodes`` of them
    :raises ValueError: for sources that do not exist or do not fit, and if there are too few
    """
    if n_episodes is not None:
        check("n_episodes", n_episodes, integer(1))
    parts = [source] if isinstance(source, (str, Path, Demonstration)) else list(source)
    if not parts:
        raise ValueError("No demonstrations given: expected 'expert', the path of a file (.h5), or a list of Demonstrations.")
    found: list[Demonstration] = []
    for part in parts:
        wanted = None if n_episodes is None else n_episodes - len(found)
        if wanted is None or wanted > 0:
            found += _from(part, env, wanted, seed, hold)
    if n_episodes is not None and len(found) < n_episodes:
        raise ValueError(f"{n_episodes} demonstrations are wanted, {source!r} has {len(found)}: ask for at most that many.")
    return found[:n_episodes]


def _from(source: Any, env: VecEnv | gym.Env, n_episodes: int | None, seed: int | None, hold: bool) -> list[Demonstration]:
    if isinstance(source, Demonstration):
        return [source]
    if not isinstance(source, (str, Path)):
        raise ValueError(
            f"Demonstrations must be 'expert', the path of a file (.h5), or Demonstrations, got {type(source).__name__}."
        )
    if source == EXPERT:
        if n_episodes is None:
            raise ValueError("How many demonstrations shall the expert give? Say n_episodes, for instance 200.")
        vec_env = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
        return record_demonstrations(vec_env, n_episodes, seed, hold)
    space = as_dict_space(env.observation_space)
    return read_demonstrations(source, space, env.action_space, None if isinstance(env, VecEnv) else env)
