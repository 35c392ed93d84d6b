"""Demonstrations from wherever they are."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cpm.arguments import check, check_names, integer
from sb3_cpm.buffers import Demonstration
from sb3_cpm.buffers.demonstrations import read_demonstrations
from sb3_cpm.dreamer.spaces import as_dict_space
from sb3_cpm.imitation.datasets import read_lerobot, read_minari
from sb3_cpm.imitation.recording import record_demonstrations

#: ``source`` for the environment's own expert.
EXPERT = "expert"
MINARI, LEROBOT = "minari:", "lerobot:"
EXPECTED = (
    "'expert', the path of a file (.h5), 'minari:NAME', 'lerobot:FOLDER', a MinariDataset, Demonstrations, or "
    "{source: one of these, keys: {...}}"
)

Source = str | Path | Demonstration | Mapping[str, Any] | Sequence[Any]


def load_demonstrations(
    source: Source,
    env: VecEnv | gym.Env,
    n_episodes: int | None = None,
    seed: int | None = None,
    hold: bool = False,
    keys: Mapping[str, str] | None = None,
    missing_reward: float | None = None,
) -> list[Demonstration]:
    """
    :param source: ``"expert"``, the environment's own (:func:`record_demonstrations`); the path of a file of ManiSkill
        (``.h5``); ``"minari:NAME"``, a ``MinariDataset`` or its folder; ``"lerobot:FOLDER"`` or the folder; demonstrations;
        a list of these; or, for YAML, one with the arguments that only it needs, ``{source: lerobot:FOLDER, keys: {...}}``
    :param env: the training environments; where recorded actions have to be replayed, a single one, as made for training
    :param n_episodes: how many; None: all that the source has. An expert must be told
    :param seed: for an expert
    :param hold: for an expert
    :param keys: by the environment's names the data set's, see :func:`~sb3_cpm.imitation.datasets.read_minari` and
        :func:`~sb3_cpm.imitation.datasets.read_lerobot`
    :param missing_reward: of every step, for data sets of LeRobot that have no rewards
    :return: the demonstrations, the first ``n_episodes`` of them
    :raises ValueError: for sources that do not exist or do not fit, and if there are too few
    """
    if n_episodes is not None:
        check("n_episodes", n_episodes, integer(1))
    parts = list(source) if isinstance(source, (list, tuple)) else [source]
    if not parts:
        raise ValueError(f"No demonstrations given: expected {EXPECTED}, or a list.")
    found: list[Demonstration] = []
    for part in parts:
        wanted = None if n_episodes is None else n_episodes - len(found)
        if wanted is None or wanted > 0:
            settings = {"keys": keys, "missing_reward": missing_reward}
            if isinstance(part, Mapping):
                check_names("demonstrations", part, ("source", *settings))
                settings |= {name: value for name, value in part.items() if name != "source"}
                part = part.get("source")
            found += _from(part, env, wanted, seed, hold, **settings)
    if n_episodes is not None and len(found) < n_episodes:
        raise ValueError(f"{n_episodes} demonstrations are wanted, {source!r} has {len(found)}: ask for at most that many.")
    return found[:n_episodes]


def _from(
    source: Any,
    env: VecEnv | gym.Env,
    n_episodes: int | None,
    seed: int | None,
    hold: bool,
    keys: Any,
    missing_reward: Any,
) -> list[Demonstration]:
    if isinstance(source, Demonstration):
        return [source]
    space = as_dict_space(env.observation_space)
    if type(source).__module__.partition(".")[0] == "minari":
        return read_minari(source, space, n_episodes, keys)
    if not isinstance(source, (str, Path)):
        raise ValueError(f"Demonstrations must be {EXPECTED}, got {type(source).__name__}.")
    if source == EXPERT:
        if n_episodes is None:
            raise ValueError("How many demonstrations shall the expert give? Say n_episodes, for instance 200.")
        vec_env = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
        return record_demonstrations(vec_env, n_episodes, seed, hold)
    name, path = str(source), Path(source)
    if name.startswith(MINARI) or any((path / "data" / file).is_file() for file in ("metadata.json", "main_data.hdf5")):
        return read_minari(name.removeprefix(MINARI), space, n_episodes, keys)
    if name.startswith(LEROBOT) or (path / "meta" / "info.json").is_file():
        return read_lerobot(name.removeprefix(LEROBOT), space, n_episodes, keys, missing_reward)
    if path.is_dir():
        raise ValueError(f"{path} is a folder of neither Minari (data/main_data.hdf5) nor LeRobot (meta/info.json).")
    if keys or missing_reward is not None:
        raise ValueError("keys and missing_reward are for data sets of Minari and LeRobot; a .h5 file has our names.")
    if not isinstance(env, VecEnv):
        return read_demonstrations(source, space, env.action_space, env)
    control_mode = env.get_attr("control_mode")[0] if env.has_attr("control_mode") else None
    return read_demonstrations(source, space, env.action_space, control_mode=control_mode)
