"""
Demonstrations: recorded episodes for :meth:`CPMBuffer.add_demonstrations <sb3_cpm.buffers.CPMBuffer.add_demonstrations>`.

Reads ManiSkill's trajectory files (``RecordEpisode``, or its solvers): ``name.h5`` holds ``traj_0, traj_1, ...`` with
``actions`` (T, A), ``terminated`` and ``truncated`` (T,), sometimes ``rewards`` (T,) and ``obs`` (T + 1, ...);
``name.json`` holds the task, controller and seed of each. Their observations are seldom the training environment's: pass
one, and the recorded actions are replayed in it, from the recorded seeds.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Demonstration:
    """
    A recorded episode of T transitions.

    :param observations: one array per key of the observation space, each of shape ``(T + 1, *observation_shape)``; images may
        have their channels last, as environments give them, where the space has them first, as SB3 puts them
    :param actions: in the environment's units, shape ``(T, *action_shape)``
    :param rewards: shape ``(T,)``
    :param terminated: the environment ended the episode itself; if not, it was cut off and the critic bootstraps
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False


def read_demonstrations(
    path: str | Path, observation_space: spaces.Dict, action_space: spaces.Space, env: Any = None
) -> list[Demonstration]:
    """
    :param path: the ``.h5`` file; the ``.json`` of the same name is read too
    :param observation_space: what the observations must be
    :param action_space: what the actions must be
    :param env: environment to replay the actions in; None: take the observations that the file holds, if they are such
    :return: its episodes
    :raises ValueError: if that cannot be done, and how it could
    """
    path = Path(path)
    h5py = _h5py()
    if isinstance(env, VecEnv):
        raise ValueError("Actions are replayed in a single environment, as gymnasium.make() gives it: `env` is a VecEnv")
    index = _read_index(path.with_suffix(".json"))
    if not path.is_file():
        raise ValueError(f"There is no file {path}")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} is not a readable HDF5 file (truncated, perhaps): {error}") from error
    with file:
        episodes, failed = [], 0
        for record in index["episodes"]:
            name = f"traj_{record['episode_id']}"
            if name not in file:
                raise ValueError(f"{path} has no {name}, which the .json file lists; the files don't belong together")
            recorded = file[name]
            _check_actions(recorded["actions"].shape[1:], action_space, record, path)
            observations = _recorded_observations(recorded, observation_space) if env is None else None
            if observations is not None and "rewards" in recorded:
                episodes.append(
                    Demonstration(
                        observations, recorded["actions"][:], recorded["rewards"][:], bool(recorded["terminated"][-1])
                    )
                )
                continue
            if env is None:
                raise ValueError(_needs_env(path, index, recorded, observations is not None))
            episode, succeeded = _replay(env, record, recorded, observation_space)
            if record.get("success", succeeded) and not succeeded:
                failed += 1
            else:
                episodes.append(episode)
    if failed:
        logger.warning(
            f"{path}: {failed} of {len(index['episodes'])} episodes did not succeed when replayed, and were left out"
        )
    if not episodes:
        raise ValueError(f"{path}: no episode could be used. Is the environment the one that they were recorded in?")
    return episodes


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ValueError(
            "Reading ManiSkill's trajectory files needs h5py: pip install h5py (it comes with mani_skill)"
        ) from error
    return h5py


def _read_index(path: Path) -> dict[str, Any]:
    try:
        index = json.loads(path.read_text())
        index["episodes"][0]["episode_id"]
    except FileNotFoundError:
        raise ValueError(f"A trajectory file comes with a .json file of the same name: there is no {path}") from None
    except (json.JSONDecodeError, KeyError, IndexError, TypeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path} does not list episodes as ManiSkill's trajectory files do ({type(error).__name__}: {error})"
        ) from None
    return index


def _check_actions(shape: tuple[int, ...], space: spaces.Space, record: dict[str, Any], path: Path) -> None:
    if shape != space.shape:
        raise ValueError(
            f"{path} holds actions of shape {shape} (controller {record.get('control_mode', 'unknown')}), the environment "
            f"takes {space.shape}. Convert them: python -m mani_skill.trajectory.replay_trajectory --traj-path {path.name} -c "
            "<the environment's control mode> -o none --save-traj"
        )


def _recorded_observations(recorded: Any, space: spaces.Dict) -> dict[str, np.ndarray] | None:
    """The file's observations if they are those of ``space``."""
    if "obs" not in recorded:
        return None
    obs = recorded["obs"]
    if not hasattr(obs, "keys"):  # a flat vector
        if len(space.spaces) != 1:
            return None
        obs = {next(iter(space.spaces)): obs}
    if not set(space.spaces) <= set(obs.keys()):
        return None
    found = {key: obs[key] for key in space.spaces}
    if any(not hasattr(array, "shape") or not _fits(array.shape[1:], space.spaces[key]) for key, array in found.items()):
        return None
    return {key: np.asarray(array[:], dtype=space.spaces[key].dtype) for key, array in found.items()}


def _fits(shape: tuple[int, ...], space: spaces.Space) -> bool:
    """Whether observations of this shape are those of the space, images also before SB3 has put their channels first."""
    return shape == space.shape or (is_image_space(space) and (*shape[-1:], *shape[:-1]) == space.shape)


def _needs_env(path: Path, index: dict[str, Any], recorded: Any, observations_fit: bool) -> str:
    kwargs = index.get("env_info", {}).get("env_kwargs", {})
    task = index.get("env_info", {}).get("env_id", "?")
    what = "rewards" if observations_fit else f"such observations (its obs_mode is {kwargs.get('obs_mode', 'none')!r})"
    return (
        f"{path} does not hold {what}. Pass env=make_maniskill_env({task!r}, ...), made as for training, and the actions are "
        "replayed in it."
    )


def _replay(env: Any, record: dict[str, Any], recorded: Any, space: spaces.Dict) -> tuple[Demonstration, bool]:
    """
    :param env: gymnasium environment
    :param record: the episode's entry in the .json
    :param recorded: its group in the .h5
    :param space: what the observations must be
    :return: what the recorded actions do there, and whether that succeeded
    """
    seed = record.get("episode_seed", record.get("reset_kwargs", {}).get("seed"))
    if isinstance(seed, list):
        seed = seed[0]
    if seed is None:
        raise ValueError(f"Episode {record['episode_id']} was recorded without a seed and cannot be replayed")
    obs, info = env.reset(seed=int(seed))
    _check_start(env, recorded, record["episode_id"], seed)
    observations, rewards, terminated = [obs], [], False
    actions = recorded["actions"][:]
    for action in actions:
        obs, reward, terminated, truncated, info = env.step(action)
        observations.append(obs)
        rewards.append(float(reward))
        if terminated or truncated:
            break
    if not isinstance(obs, Mapping) and len(space.spaces) == 1:  # Dreamer's buffer has a Box observation under one key
        observations = [dict.fromkeys(space.spaces, one) for one in observations]
    stacked = {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    succeeded = bool(info.get("is_success", info.get("success", True)))
    return Demonstration(stacked, actions[: len(rewards)], np.array(rewards), bool(terminated)), succeeded


def _check_start(env: Any, recorded: Any, number: int, seed: int) -> None:
    """Objects must lie where they lay; they do if task, robot and version are the same."""
    if "env_states" not in recorded or "actors" not in recorded["env_states"] or not hasattr(env.unwrapped, "get_state_dict"):
        return
    actors = env.unwrapped.get_state_dict()["actors"]
    for name, states in recorded["env_states"]["actors"].items():
        if name not in actors or not np.allclose(
            np.asarray(actors[name].cpu()).reshape(-1)[:3], states[0].reshape(-1)[:3], atol=1e-3
        ):
            raise ValueError(
                f"Episode {number} starts elsewhere when replayed: {name!r} is not where it was after reset(seed={seed}). "
                "Make the environment with the task, robot_uids and ManiSkill version that it was recorded with."
            )


def as_transitions(
    episode: Demonstration, observation_space: spaces.Dict, action_space: spaces.Space
) -> Iterator[tuple[Any, ...]]:
    """
    :param episode: a demonstration
    :return: for each step, what a buffer's ``add()`` takes, for one environment
    :raises ValueError: for shapes and values that cannot be
    """
    n_steps = len(episode.rewards)
    if n_steps == 0:
        raise ValueError("A demonstration has no steps")
    missing = set(observation_space.spaces) - set(episode.observations)
    if missing:
        raise ValueError(f"A demonstration lacks the observations {sorted(missing)}")
    observations = {}
    for key, space in observation_space.spaces.items():
        wanted = (n_steps + 1, *(space.shape or ()))
        array = np.asarray(episode.observations[key])
        if array.shape != wanted and _fits(array.shape[1:], space):
            array = np.moveaxis(array, -1, 1)  # as SB3's VecTransposeImage does around the training environment
        if array.shape != wanted:
            raise ValueError(
                f"A demonstration of {n_steps} steps has observations {key!r} of shape {array.shape}, expected {wanted}"
            )
        observations[key] = array
    actions = np.asarray(episode.actions)
    if actions.shape != (n_steps, *(action_space.shape or ())):
        raise ValueError(
            f"A demonstration of {n_steps} steps has actions of shape {actions.shape}, the space is {action_space}"
        )
    actions = _scaled(actions, action_space).reshape(n_steps, -1)
    for step in range(n_steps):
        last = step == n_steps - 1
        yield (
            {key: array[step][None] for key, array in observations.items()},
            {key: array[step + 1][None] for key, array in observations.items()},
            actions[step][None],
            np.asarray([episode.rewards[step]], dtype=np.float32),
            np.array([last]),
            [{"TimeLimit.truncated": last and not episode.terminated}],
        )


def _scaled(actions: np.ndarray, space: spaces.Space) -> np.ndarray:
    """To [-1, 1], as buffers hold them."""
    if not isinstance(space, spaces.Box):
        return actions
    scaled = 2.0 * (actions - space.low) / (space.high - space.low) - 1.0
    if not np.abs(scaled).max(initial=0.0) <= 1.001:  # NaN fails too
        raise ValueError(f"A demonstration has actions in [{actions.min():.4g}, {actions.max():.4g}], outside of {space}")
    return np.clip(scaled, -1.0, 1.0).astype(np.float32)
