"""
Demonstrations: recorded episodes for :meth:`CPMBuffer.add_demonstrations <sb3_cpm.buffers.CPMBuffer.add_demonstrations>`.

Reads ManiSkill's trajectory files (``RecordEpisode``, or its solvers): ``name.h5`` holds ``traj_0, traj_1, ...`` with
``actions`` (T, A), ``terminated`` and ``truncated`` (T,), sometimes ``rewards`` (T,) and ``obs`` (T + 1, ...);
``name.json`` holds the task, controller and seed of each. Their observations are seldom the training environment's: pass
one, and the recorded actions are replayed in it, from the recorded seeds.
"""

import io
import json
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm.arguments import error_prefix
from sb3_cpm.extras import needed
from sb3_cpm.files import write_bytes, write_text

logger = logging.getLogger(__name__)

#: Controllers whose demonstrations ManiSkill's ``replay_trajectory`` converts.
CONVERTED = ("pd_joint_pos", "pd_joint_delta_pos")
#: Share of a demonstration's actions that may be clipped; of more than that another unit is the likelier reason.
MOST_CLIPPED = 0.5


@dataclass(frozen=True)
class Demonstration:
    """
    A recorded episode of T transitions.

    :param observations: one array per key of the observation space, each of shape ``(T + 1, *observation_shape)``; images may
        have their channels last, as environments give them, where the space has them first, as SB3 puts them
    :param actions: in the environment's units, shape ``(T, *action_shape)``; clipped to the environment's bounds
    :param rewards: shape ``(T,)``
    :param terminated: the environment ended the episode itself; if not, it was cut off and the critic bootstraps
    :param instance: which object it was about, as the environment's ``info["instance"]`` names it; None if it names none
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False
    instance: str | None = None


def read_demonstrations(
    path: str | Path,
    observation_space: spaces.Dict,
    action_space: spaces.Space,
    env: Any = None,
    control_mode: str | None = None,
) -> list[Demonstration]:
    """
    :param path: the ``.h5`` file; the ``.json`` of the same name is read too
    :param observation_space: what the observations must be
    :param action_space: what the actions must be
    :param env: environment to replay the actions in; None: take the observations that the file holds, if they are such
    :param control_mode: the environment's; None: that of ``env``
    :return: its episodes
    :raises ValueError: if that cannot be done, and how it could
    """
    path = Path(path)
    with needed("ManiSkill's trajectory files", "demonstrations"):
        import h5py
    if isinstance(env, VecEnv):
        raise ValueError(
            "Actions are replayed in a single environment: `env` is a VecEnv. Pass one as gymnasium.make() or "
            "make_maniskill_env() gives it."
        )
    control_mode = control_mode or getattr(getattr(env, "unwrapped", None), "control_mode", None)
    index = _read_index(path.with_suffix(".json"))
    if not path.is_file():
        raise ValueError(f"There is no file {path}: `source` is the path of ManiSkill's .h5, or a list of Demonstrations.")
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
            _check_actions(recorded["actions"].shape[1:], action_space, record, path, control_mode)
            observations = _recorded_observations(recorded, observation_space) if env is None else None
            if observations is not None and "rewards" in recorded:
                episodes.append(
                    Demonstration(
                        observations,
                        recorded["actions"][:],
                        recorded["rewards"][:],
                        bool(recorded["terminated"][-1]),
                        record.get("instance"),
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


def write_demonstrations(
    path: str | Path,
    episodes: Sequence[Demonstration],
    env_id: str,
    env_kwargs: Mapping[str, Any],
    control_mode: str | None = None,
) -> None:
    """
    As ManiSkill's files are, with observations, rewards and the instance: :func:`read_demonstrations` needs no environment.

    :param path: the ``.h5`` file; the ``.json`` of the same name is written, too, after it
    :param episodes: to write
    :param env_id: ManiSkill's or gymnasium's name of the task
    :param env_kwargs: what it was made with, plain data
    :param control_mode: of its robot, if it has one
    :raises NotWrittenError: if the disk does not take it; nothing is there then
    """
    path = Path(path)
    with needed("ManiSkill's trajectory files", "demonstrations"):
        import h5py
    index: dict[str, Any] = {"env_info": {"env_id": env_id, "env_kwargs": dict(env_kwargs)}, "episodes": []}
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for number, episode in enumerate(episodes):
            group = file.create_group(f"traj_{number}")
            ends = np.zeros(len(episode.rewards), dtype=bool)
            ends[-1] = True
            group["actions"], group["rewards"] = episode.actions, np.asarray(episode.rewards, np.float32)
            group["terminated"], group["truncated"] = ends & episode.terminated, ends & (not episode.terminated)
            for key, array in episode.observations.items():
                group.create_dataset(f"obs/{key}", data=array, compression="gzip" if array.ndim > 2 else None)
            record = {"episode_id": number, "success": True, "instance": episode.instance}
            index["episodes"].append(record if control_mode is None else {**record, "control_mode": control_mode})
    write_bytes(path, content.getvalue())
    write_text(path.with_suffix(".json"), json.dumps(index, indent=1) + "\n")


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


def _check_actions(
    shape: tuple[int, ...], space: spaces.Space, record: dict[str, Any], path: Path, control_mode: str | None
) -> None:
    recorded = record.get("control_mode")
    other = recorded is not None and control_mode is not None and recorded != control_mode
    if shape == space.shape and not other:
        return
    wanted = control_mode or "<the environment's control mode>"
    if recorded is None or recorded in CONVERTED:
        command = f"python -m mani_skill.trajectory.replay_trajectory --traj-path {path.name}"
        cure = f"Convert them: {command} -c {wanted} -o none --save-traj"
    else:
        cure = (
            f"ManiSkill's replay_trajectory converts those of {' and '.join(CONVERTED)} only. Record them anew (python -m "
            f"sb3_cpm demonstrate ... --env-kwargs control_mode={wanted}), or make the environment with "
            f"control_mode={recorded!r}."
        )
    raise ValueError(
        f"{path} holds actions of shape {shape} (controller {recorded or 'unknown'}), the environment takes {space.shape} "
        f"(controller {control_mode or 'unknown'}). {cure}"
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
    if any(key not in obs for key in space.spaces):  # "a/b" is b within a
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
        raise ValueError(
            f"Episode {record['episode_id']} was recorded without a seed and cannot be replayed. Record it anew with one "
            "(RecordEpisode keeps that of reset(seed=...)), or remove it from the .json."
        )
    obs, info = env.reset(seed=int(seed))
    _check_start(env, recorded, record["episode_id"], seed)
    observations, rewards, terminated = [obs], [], False
    actions = recorded["actions"][:]
    bounds = env.action_space if isinstance(env.action_space, spaces.Box) else None
    for action in actions:
        # what a Gaussian policy gives lies outside now and then: most environments clip it, some refuse it
        clipped = action if bounds is None else np.clip(action, bounds.low, bounds.high)
        obs, reward, terminated, truncated, info = env.step(clipped)
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
    episodes: Sequence[Demonstration], observation_space: spaces.Dict, action_space: spaces.Space
) -> list[tuple[Any, ...]]:
    """
    :param episodes: demonstrations
    :return: for each step, what a buffer's ``add()`` takes, for one environment; see :func:`as_arrays`
    """
    arrays = as_arrays(episodes, observation_space, action_space)
    return [
        step
        for (observations, actions, rewards), episode in zip(arrays, episodes, strict=True)
        for step in _steps(observations, actions, rewards, episode.terminated)
    ]


def as_arrays(
    episodes: Sequence[Demonstration], observation_space: spaces.Dict, action_space: spaces.Space
) -> list[tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]]:
    """
    Actions outside of their bounds, as those of a Gaussian policy are now and then, are clipped, as environments do with them;
    a warning counts them.

    :param episodes: demonstrations
    :return: for each its observations by key, shape ``(T + 1, ...)``, images as the space has them; actions within [-1, 1],
        shape ``(T, action_dim)``; and rewards, shape ``(T,)``
    :raises ValueError: for shapes and values that cannot be, naming the demonstration, what came, and what to do
    """
    arrays = []
    n_clipped = np.zeros(len(episodes), dtype=np.int64)
    for number, episode in enumerate(episodes):
        with error_prefix(f"Demonstration {number} of {len(episodes)}"):
            if not isinstance(episode, Demonstration):
                raise ValueError(f"expected a sb3_cpm.buffers.Demonstration, got {type(episode).__name__}.")
            rewards = _rewards(episode)
            observations = _observations(episode, len(rewards), observation_space)
            actions, n_clipped[number] = _actions(episode, len(rewards), action_space)
        arrays.append((observations, actions, rewards))
    if n_clipped.any():
        warnings.warn(
            f"Actions of demonstrations outside of {action_space} are clipped to it, as environments do: {n_clipped.sum()} "
            f"numbers, in {np.count_nonzero(n_clipped)} of {len(episodes)} demonstrations.",
            stacklevel=3,
        )
    return arrays


def _rewards(episode: Demonstration) -> np.ndarray:
    rewards = np.asarray(episode.rewards)
    if rewards.ndim != 1 or len(rewards) == 0 or rewards.dtype.kind not in "biuf":
        raise ValueError(
            f"rewards must be a number per step, shape (T,), for at least one step, got {rewards.dtype} of shape "
            f"{rewards.shape}. Flatten them (np.ravel), or leave the demonstration out."
        )
    broken = np.flatnonzero(~(np.abs(rewards) <= np.finfo(np.float32).max))
    if len(broken):
        step = int(broken[0])
        raise ValueError(
            f"the reward of step {step} is {rewards[step]}. Rewards must be finite: mend it, or leave the demonstration out."
        )
    return rewards.astype(np.float32)


def _observations(episode: Demonstration, n_steps: int, observation_space: spaces.Dict) -> dict[str, np.ndarray]:
    missing = set(observation_space.spaces) - set(episode.observations)
    if missing:
        raise ValueError(
            f"it lacks the observations {sorted(missing)}. Record them, or make the training environment without them."
        )
    observations = {}
    for key, space in observation_space.spaces.items():
        wanted = (n_steps + 1, *(space.shape or ()))
        array = np.asarray(episode.observations[key])
        if array.shape != wanted and array.shape[:1] == wanted[:1] and _fits(array.shape[1:], space):
            array = np.moveaxis(array, -1, 1)  # as SB3's VecTransposeImage does around the training environment
        if array.shape != wanted:
            raise ValueError(
                f"{n_steps} steps need observations {key!r} of shape {wanted} (the last one, which no action was taken in, "
                f"included), got {array.shape}."
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"observations {key!r} hold NaN or infinite values. Leave the demonstration out, or mend them.")
        observations[key] = array
    return observations


def _actions(episode: Demonstration, n_steps: int, space: spaces.Space) -> tuple[np.ndarray, int]:
    """:return: actions within [-1, 1], as buffers hold them, shape ``(T, action_dim)``, and how many numbers were clipped"""
    actions = np.asarray(episode.actions)
    if actions.shape != (n_steps, *(space.shape or ())) or actions.dtype.kind not in "biuf":
        raise ValueError(
            f"{n_steps} steps need actions of shape {(n_steps, *(space.shape or ()))}, got {actions.dtype} of shape "
            f"{actions.shape}: the environment takes {space}."
        )
    if not np.isfinite(actions).all():
        raise ValueError("its actions hold NaN or infinite values. Leave the demonstration out.")
    if not isinstance(space, spaces.Box):
        if (actions != np.clip(np.trunc(actions), -(2**31), 2**31)).any():
            raise ValueError(f"its actions must be whole numbers, those of {space}. Leave the demonstration out.")
        return actions.reshape(n_steps, -1), 0
    width = space.high.astype(np.float64) - space.low
    if not (np.isfinite(width) & (width > 0)).all():
        raise ValueError(f"actions are scaled by their bounds, which {space} does not have. Declare them in the environment.")
    scaled = 2.0 * (actions - space.low.astype(np.float64)) / width - 1.0
    outside = np.abs(scaled) > 1.001  # rounding errors are nobody's concern
    if outside.mean() > MOST_CLIPPED:
        raise ValueError(
            f"{outside.mean():.0%} of the numbers in its actions lie outside of {space}, from {actions.min():.4g} to "
            f"{actions.max():.4g}: they seem to be in other units. Scale them to the environment's, or, if the environment "
            "clips them, do so yourself (np.clip(actions, space.low, space.high))."
        )
    return np.clip(scaled, -1.0, 1.0).astype(np.float32).reshape(n_steps, -1), int(outside.sum())


def _steps(
    observations: dict[str, np.ndarray], actions: np.ndarray, rewards: np.ndarray, terminated: bool
) -> Iterator[tuple[Any, ...]]:
    for step in range(len(rewards)):
        last = step == len(rewards) - 1
        yield (
            {key: array[step][None] for key, array in observations.items()},
            {key: array[step + 1][None] for key, array in observations.items()},
            actions[step][None],
            rewards[step][None],
            np.array([last]),
            [{"TimeLimit.truncated": last and not terminated}],
        )
