"""
Checkpoints: all that a run needs to go on, in one folder, which is whole or not there.

SB3 restores neither random states nor environments. A run that is to go on as if nothing had happened makes a fresh start at
every checkpoint, whether it was killed or not (:func:`fresh_start`): all random generators are seeded from (seed, step), and
the environments begin new episodes. What a resumed run does from there on is then the same as what an unbroken one does.

Of its files only ``model.zip``, which is SB3's own, can execute code when it is read; all others are arrays and JSON.
:mod:`sb3_cpm.checkpoint_callback` is the same for people's own code.
"""

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cpm.buffers import CPMBuffer, EpisodeBuffer
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.files import (
    Archive,
    DamagedFileError,
    DamagedRunError,
    check_finite,
    disk_errors_named,
    verify,
    write_archive,
    write_sealed,
)
from sb3_cpm.packing import pack, unpack
from sb3_cpm.randomness import random_state
from sb3_cpm.seeds import FIRST_SEED
from sb3_cpm.stateful import StatefulCallback
from sb3_cpm.training_env import begin_episodes

NAME = "checkpoint"
MODEL, BUFFER, STATE = "model.zip", "replay_buffer.npz", "state.npz"
#: Of the state; files of before there were versions lack it.
VERSION = 2

#: Attributes of SB3's replay buffers that come from their arguments.
_OF_ARGUMENTS = {"observation_space", "action_space", "obs_shape", "device", "env", "goal_selection_strategy"}


def save_checkpoint(folder: Path, model: BaseAlgorithm, callbacks: Sequence[BaseCallback], extra: dict[str, Any]) -> None:
    """
    Write a complete checkpoint, then let it take the place of the last one.

    :param folder: of the run, which is there
    :param model: with its replay buffer, where it has one; between two rollouts, so that the last one is in it
    :param callbacks: challengers and others with a state are saved
    :param extra: plain data to be given back by :func:`load_extra`
    :raises NotWrittenError: if the disk does not take it; the last one stays
    :raises NotFiniteError: if a weight is not finite; the last one stays, too
    """
    new, current, old = (folder / f"{NAME}{suffix}" for suffix in (".new", "", ".old"))
    shutil.rmtree(new, ignore_errors=True)
    with disk_errors_named(new):
        new.mkdir()
    try:
        _write(new, model, callbacks, extra)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    with disk_errors_named(current):
        if current.exists():  # else a process was killed between these lines, and the last one is `old`
            shutil.rmtree(old, ignore_errors=True)
            os.replace(current, old)
        os.replace(new, current)
    shutil.rmtree(old, ignore_errors=True)


def save_model(path: Path, model: BaseAlgorithm) -> None:
    """
    SB3's own archive, written whole, with a digest.

    :param path: of the file
    :param model: to save
    :raises NotFiniteError: if a weight is not finite; the last good file stays
    :raises NotWrittenError: if the disk does not take it; the last good file stays, too
    """
    _, variables = model._get_torch_save_params()
    check_finite(path, "model", {name: recursive_getattr(model, name, None) for name in variables} | model.get_parameters())
    write_sealed(path, model.save)


def _write(new: Path, model: BaseAlgorithm, callbacks: Sequence[BaseCallback], extra: dict[str, Any]) -> None:
    arrays: dict[str, np.ndarray] = {}
    content: dict[str, Any] = {"version": VERSION, "extra": pack(extra, name="extra")}
    content["random"] = pack(random_state(model.action_space))
    save_model(new / MODEL, model)
    content["model_class"] = _name_of_class(type(model))
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, EpisodeBuffer):
        buffer.save(new / BUFFER)
    elif buffer is not None:
        content["buffer"] = _state_of_buffer(buffer, arrays)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        content["normalization"] = pack({name: _numbers(one) for name, one in _statistics(normalize).items()})
    content["challengers"] = {}
    for index, callback in _challengers(callbacks):
        callback.save(new / _challenger_file(index))
        storable, rest = _storable(callback.arguments)
        progress = callback.state_dict()["progress"]
        content["challengers"][str(index)] = {"arguments": storable, "not stored": rest, "progress": pack(progress)}
    content["callbacks"] = {}
    for index, other in enumerate(callbacks):
        if isinstance(other, StatefulCallback) and other.has_state:
            other.save(new / _callback_file(index))
            content["callbacks"][str(index)] = type(other).__name__
    content["files"] = [STATE, *(path.name for path in sorted(new.iterdir()))]
    write_archive(new / STATE, content, arrays)  # the last one: where it is, all are


def _challengers(callbacks: Sequence[BaseCallback]) -> list[tuple[int, ChallengerCallback]]:
    """Those that have a challenger yet, with their index."""
    found = [(index, one) for index, one in enumerate(callbacks) if isinstance(one, ChallengerCallback)]
    return [(index, one) for index, one in found if one.challenger is not None]


def _challenger_file(index: int) -> str:
    return f"challenger{index}.pt"


def _callback_file(index: int) -> str:
    return f"callback{index}.npz"


def _storable(arguments: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """:return: the arguments of a callback that are plain data, packed, and the names of the others"""
    packed, rest = {}, []
    for name, value in arguments.items():
        try:
            packed[name] = pack(str(value) if isinstance(value, (Path, th.device)) else value)
        except ValueError:  # a function, a class
            rest.append(name)
    return packed, rest


def _name_of_class(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def find_checkpoint(folder: Path) -> Path | None:
    """
    :param folder: of a run
    :return: its newest complete checkpoint, whole
    :raises DamagedRunError: if it is not what was written, or was written by an earlier version
    """
    for name in (NAME, f"{NAME}.old"):
        checkpoint = folder / name
        if (checkpoint / "state.pkl").exists():
            raise _earlier_version(checkpoint, ", as pickles, which can execute anything when they are read")
        if (checkpoint / STATE).exists():
            _check(checkpoint)
            return checkpoint
    return None


def _check(checkpoint: Path) -> None:
    remove = f"Remove {checkpoint} to begin the run anew."
    try:
        for path in sorted(checkpoint.iterdir()):
            if not verify(path):
                raise DamagedFileError(f"{path} has no digest: this package did not write it.")
        with Archive(checkpoint / STATE, "checkpoint") as archive:
            if archive.content.get("version") != VERSION:
                raise _earlier_version(checkpoint)
            missing = [name for name in archive.content["files"] if not (checkpoint / name).is_file()]
    except DamagedFileError as error:
        told = str(error).replace(" Take an earlier one.", "")  # there is none
        raise DamagedRunError(f"{told} {remove}") from error
    if missing:
        raise DamagedRunError(f"{checkpoint} is half a checkpoint: {', '.join(missing)} is gone. {remove}")


def _earlier_version(checkpoint: Path, how: str = "") -> DamagedRunError:
    return DamagedRunError(
        f"{checkpoint} was written by an earlier sb3_cpm{how}: finish the run with that version, or remove {checkpoint} to "
        "begin it anew."
    )


def remove_checkpoints(folder: Path) -> None:
    for suffix in ("", ".new", ".old"):
        shutil.rmtree(folder / f"{NAME}{suffix}", ignore_errors=True)


def load_extra(checkpoint: Path) -> dict[str, Any]:
    """
    :return: what was given to :func:`save_checkpoint`
    :raises ValueError: if the file is damaged
    """
    with Archive(checkpoint / STATE, "checkpoint") as archive:
        return unpack(archive.content["extra"])


def restore(checkpoint: Path, model: BaseAlgorithm, callbacks: Sequence[BaseCallback] = ()) -> None:
    """
    Give model and challengers back what they had. The episodes that went on then are over, and new ones begin.

    :param checkpoint: of :func:`find_checkpoint`
    :param model: loaded from ``model.zip`` of this checkpoint
    :param callbacks: like those that were saved; challengers among them get their state back, before ``learn()``
    :raises ValueError: if a challenger does not fit, or the environment is normalized otherwise
    """
    with Archive(checkpoint / STATE, "checkpoint") as archive:
        saved = archive.content["challengers"]
    restore_buffer(checkpoint, model)
    buffer = getattr(model, "replay_buffer", None)
    if (
        isinstance(buffer, CPMBuffer) and saved
    ):  # the episodes that end here are the challenger's, as those that end in learn()
        buffer.attach_challenger()
    begin_episodes(model)
    if isinstance(buffer, CPMBuffer):
        buffer.detach_challenger()
    for index, entry in saved.items():
        callback = callbacks[int(index)]
        assert isinstance(callback, ChallengerCallback)
        callback.init_callback(model)
        assert callback.challenger is not None
        callback.challenger.load_state(checkpoint / _challenger_file(int(index)))
        callback.load_state_dict({"challenger": None, "progress": unpack(entry["progress"])})
    for index, callback in enumerate(callbacks):
        path = checkpoint / _callback_file(index)
        if isinstance(callback, StatefulCallback) and path.exists():
            callback.init_callback(model)
            callback.load(path)


def restore_buffer(checkpoint: Path, model: BaseAlgorithm) -> None:
    """:param model: loaded from ``model.zip`` of this checkpoint; gets its replay buffer and normalization back"""
    buffer = getattr(model, "replay_buffer", None)
    with Archive(checkpoint / STATE, "checkpoint") as archive:
        if isinstance(buffer, EpisodeBuffer):
            loaded = type(buffer).load(checkpoint / BUFFER, env=buffer.env)
            loaded.device = model.device
            model.replay_buffer = loaded  # type: ignore[attr-defined]
        elif buffer is not None:
            _restore_buffer(buffer, archive)
        normalize = model.get_vec_normalize_env()
        if normalize is not None:
            saved = unpack(archive.content["normalization"])
            for name, one in _statistics(normalize).items():
                one.mean, one.var, one.count = saved[name]


def _statistics(normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    """What VecNormalize has counted, by name."""
    counted = getattr(normalize, "obs_rms", None)  # not there with norm_obs=False
    of_observations = counted if isinstance(counted, dict) else {"": counted}
    found = {"returns": normalize.ret_rms, **{f"observations {key}": one for key, one in of_observations.items()}}
    return {name: one for name, one in found.items() if isinstance(one, RunningMeanStd)}


def _numbers(statistics: RunningMeanStd) -> tuple[Any, ...]:
    return statistics.mean, statistics.var, statistics.count


def _state_of_buffer(buffer: ReplayBuffer, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """
    A replay buffer of SB3's own, attribute by attribute, as far as it has been filled.

    :param buffer: the buffer
    :param arrays: its arrays are added to these
    :return: the rest
    :raises ValueError: for a buffer that holds something else than arrays and numbers
    """
    used = buffer.buffer_size if buffer.full else buffer.pos
    rest = {}
    for name, value in vars(buffer).items():
        parts = value if isinstance(value, dict) else {None: value}
        if name in _OF_ARGUMENTS:
            continue
        if all(isinstance(part, np.ndarray) and not part.dtype.hasobject for part in parts.values()):
            for key, part in parts.items():
                per_transition = part.shape[:2] == (buffer.buffer_size, buffer.n_envs)
                arrays[_name(name, key)] = part[:used] if per_transition else part
        elif isinstance(value, np.ndarray):  # HER's infos: dicts, empty ones unless they are asked for
            rest[name] = pack(value[:used].tolist() if getattr(buffer, "copy_info_dict", True) else [], name=name)
        else:
            rest[name] = pack(value, name=f"{type(buffer).__name__}.{name}")
    return rest


def _restore_buffer(buffer: ReplayBuffer, archive: Archive) -> None:
    """:param buffer: an empty one like the one that was saved"""
    saved = {name: unpack(value) for name, value in archive.content["buffer"].items()}
    for name, value in vars(buffer).items():
        if name in _OF_ARGUMENTS:
            continue
        if name in saved and not isinstance(value, np.ndarray):
            setattr(buffer, name, saved[name])
        elif name in saved:
            for row, infos in enumerate(saved[name]):
                for env_idx, info in enumerate(infos):
                    value[row, env_idx] = info
        else:
            for key, part in (value if isinstance(value, dict) else {None: value}).items():
                stored = archive.array(_name(name, key))
                part[: len(stored)] = stored


def _name(attribute: str, key: str | None) -> str:
    return attribute if key is None else f"{attribute}/{quote(key, '')}"


def fresh_start(model: BaseAlgorithm, seed: int, callbacks: Sequence[BaseCallback] = ()) -> None:
    """
    Seed everything from (seed, number of steps so far) and begin new episodes.

    :param model: before a rollout
    :param seed: of the run
    :param callbacks: of the run; what a challenger among them has put around the environments begins anew, too
    """
    wrappers = [one.exploration_env for _, one in _challengers(callbacks) if one.exploration_env is not None]
    model.set_random_seed(seed_at(model.num_timesteps, seed, model.n_envs))
    begin_episodes(model, wrappers[-1] if wrappers else None, counted=True)
    if model.use_sde:  # SB3 has drawn the noise of the rollout that begins, before it told anybody
        noisy = model.policy if isinstance(model, OnPolicyAlgorithm) else model.policy.actor
        noisy.reset_noise(model.n_envs)  # type: ignore[operator, union-attr]


def seed_at(step: int, seed: int, n_envs: int) -> int:
    """:return: the seed of what comes after a checkpoint at this step, one of those that evaluation does not have"""
    words = np.random.SeedSequence([seed, step]).generate_state(1)
    return int(words[0]) % (FIRST_SEED - n_envs)
