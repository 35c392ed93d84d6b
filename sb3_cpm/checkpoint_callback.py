"""
Checkpoints in people's own code: a callback that makes them, and :func:`resume`, which goes on from one.

::

    callback = ChallengerCallback(decay_steps=100_000)
    model.learn(100_000, callback=[callback, CheckpointCPMCallback(1000, "runs/mine")])

    model, callback = resume("runs/mine", env)
    model.learn(100_000 - model.num_timesteps, callback=[callback, CheckpointCPMCallback(1000, "runs/mine")],
                reset_num_timesteps=False)
"""

import importlib
import logging
import os
import re
import signal
import sys
import threading
import warnings
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.arguments import check, integer, names_checked
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.files import Archive, LockedError, NotFiniteError, NotWrittenError, disk_errors_named, locked
from sb3_cpm.packing import unpack
from sb3_cpm.randomness import restore_random_state
from sb3_cpm.stateful import StatefulCallback
from sb3_cpm.training_env import learns

logger = logging.getLogger(__name__)

#: What a shell says of a process that SIGTERM has ended.
TERMINATED = 128 + 15


class CheckpointCPMCallback(BaseCallback):
    """
    Saves everything that a run needs to go on, in one folder, every ``save_freq`` calls of ``env.step()`` and at the end of
    ``learn()``: model, replay buffer with its challenges and coefficients, challenger, the discriminator and rings of a
    ``GAILCallback``, the statistics of a ``VecNormalize``, counters, and the states of all random generators. :func:`resume`
    goes on from there. Also for Dreamer and Plan2Explore, for other buffers of SB3's, and for on-policy algorithms.

    A checkpoint is made between two rollouts, the first time after it is due, and takes the place of the one before only when
    it is whole. Where that cannot be (the disk is full or read-only, a weight is not finite, another process is writing the
    folder) the log says so in one line, the one before stays, and the next one is tried when it is due.

    :param save_freq: calls of ``env.step()`` between two checkpoints, which are ``n_envs`` steps each, as for SB3's
        ``CheckpointCallback``
    :param folder: for this run alone; made if need be. The checkpoint is the folder ``checkpoint`` in it
    :param verbose: 2 says when a checkpoint was made
    :param exact: make a fresh start at the beginning of ``learn()`` and after each checkpoint: all generators are seeded from
        the model's seed and the number of steps, and the environments begin new episodes. A run that was killed and resumed is
        then bit for bit the unbroken one (on one machine, for environments that do what their seed says). Without, nothing of
        the run is changed, and the resumed run begins new episodes where the unbroken one would have gone on with its own
    :param on_sigterm: let SIGTERM, which clusters send before they take a machine back, make a checkpoint at the end of the
        rollout (with ``exact``, where that would be another run, the last one stays), and then end the program with
        ``SystemExit(143)``. For ``learn()`` in the main thread only; after it, the handler of before is back. Environments in
        processes of their own must not get the signal, or the last checkpoint is what remains
    :raises ValueError: for arguments that cannot work; in ``learn()``, if ``exact`` is asked of a model without seed
    """

    @names_checked()
    def __init__(
        self, save_freq: int, folder: str | os.PathLike, verbose: int = 0, exact: bool = False, on_sigterm: bool = False
    ) -> None:
        super().__init__(verbose)
        check("save_freq", save_freq, integer(1))
        self.save_freq = save_freq
        self.folder = Path(folder)
        self.exact = exact
        self.on_sigterm = on_sigterm
        self._next_save = 0
        self._saved_at: int | None = None
        self._begins = False
        self._listener: _Listener | None = None

    def _on_training_start(self) -> None:
        if self.exact and self.model.seed is None:
            raise ValueError(
                "CheckpointCPMCallback(exact=True) begins afresh from the model's seed, but it has none: "
                f"{type(self.model).__name__}(..., seed=0)."
            )
        if self._saved_at is None:
            self._check_folder()
        self._begins = True
        self._schedule()
        if self.on_sigterm:
            if threading.current_thread() is threading.main_thread():
                self._listener = _Listener(self.model)
            else:
                warnings.warn("SIGTERM is not listened to: Python tells the main thread only, and learn() is in another one.")

    def _check_folder(self) -> None:
        """A run that begins does not replace what another one has reached."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder} is a file: expected the name of a folder for checkpoints.")
        there = checkpoints.find_checkpoint(self.folder)
        steps = 0 if there is None else checkpoints.load_extra(there).get("steps", 0)
        if steps > self.model.num_timesteps:
            raise ValueError(
                f"{self.folder} holds the checkpoint of a run at step {steps}, and this model is at step "
                f"{self.model.num_timesteps}: resume({str(self.folder)!r}, env) goes on with that run. To begin another one, "
                f"choose another folder, or remove {there}."
            )

    def _schedule(self) -> None:
        self._next_save = (self._n_env_steps // self.save_freq + 1) * self.save_freq

    @property
    def _n_env_steps(self) -> int:
        """Calls of ``env.step()``, those of earlier processes included: a resumed run saves when the unbroken one does."""
        return self.model.num_timesteps // self.model.n_envs

    def _on_rollout_start(self) -> None:
        terminated = self._listener is not None and self._listener.heard
        due = self._n_env_steps >= self._next_save
        if due or (terminated and not self.exact):
            self._save()
            self._schedule()
        if terminated:
            self._terminate()
        if self.exact and (due or self._begins):
            assert self.model.seed is not None
            checkpoints.fresh_start(self.model, self.model.seed, self._with_state())
        self._begins = False

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if self._saved_at != self.model.num_timesteps:
            self._save()
        if self._listener is not None:
            if self._listener.heard:
                self._terminate()
            self._listener.close()

    def _terminate(self) -> NoReturn:
        assert self._listener is not None
        self._listener.close()
        raise SystemExit(TERMINATED)

    def _with_state(self) -> list[BaseCallback]:
        """Those of this ``learn()`` that a checkpoint keeps, a challenger first."""
        kept = [one for one in _flat(self.locals["callback"]) if isinstance(one, (ChallengerCallback, StatefulCallback))]
        return sorted(kept, key=lambda one: not isinstance(one, ChallengerCallback))

    def _save(self) -> None:
        steps = self.model.num_timesteps
        try:
            with disk_errors_named(self.folder):
                self.folder.mkdir(parents=True, exist_ok=True)
            with locked(self.folder):
                extra = {"steps": steps, "exact": self.exact}
                checkpoints.save_checkpoint(self.folder, self.model, self._with_state(), extra)
        except (NotWrittenError, NotFiniteError, LockedError) as error:
            logger.warning(f"No checkpoint at step {steps}, the run goes on: {error}")
            return
        self._saved_at = steps
        if self.verbose >= 2:
            sys.stdout.write(f"Saved a checkpoint at step {steps} in {self.folder}\n")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_listener": None}  # of a running learn()


def _flat(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A list of callbacks, one by one; lists may stand in lists."""
    if isinstance(callback, CallbackList):
        for part in callback.callbacks:
            yield from _flat(part)
    else:
        yield callback


class _Listener:
    """
    Notes SIGTERM while ``learn()`` runs. An exception ends that without telling callbacks: from then on the signal is for the
    handler that was there before.

    :param model: that learns, in the main thread
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        self.heard = False
        self._model = weakref.ref(model)  # where one stays behind, it keeps no model alive
        previous: Any = signal.getsignal(signal.SIGTERM)
        while isinstance(previous, _Listener) and not learns(previous._model(), sys._getframe()):
            previous = previous.previous  # that one was left behind by a learn() that failed
        self.previous: Any = signal.SIG_DFL if previous is None else previous  # None: not one of Python's
        signal.signal(signal.SIGTERM, self)

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        if learns(self._model(), frame):
            self.heard = True
        else:
            self.close()
            os.kill(os.getpid(), signum)

    def close(self) -> None:
        """Put back what was there before."""
        current: Any = signal.getsignal(signal.SIGTERM)
        if current is self:
            signal.signal(signal.SIGTERM, self.previous)


# ---------------------------------------------------------------------- going on


def resume(
    folder: str | os.PathLike,
    env: GymEnv,
    callback: BaseCallback | None = None,
    device: th.device | str = "auto",
    model_class: type[BaseAlgorithm] | None = None,
    custom_objects: dict[str, Any] | None = None,
) -> tuple[BaseAlgorithm, Any]:
    """
    Model and challenger as they were when :class:`CheckpointCPMCallback` saved them, for ``model.learn(...,
    callback=[callback, CheckpointCPMCallback(...)], reset_num_timesteps=False)``.

    Weights, optimizers, buffer, challenges, coefficients, counters, statistics and the states of Python's, NumPy's, torch's
    and the action space's generators are those of the checkpoint, exactly. **The environment is not: it begins a new
    episode**, and the one that was running ends in the buffer where it was. See ``exact`` of the callback for runs that do
    so anyway.

    ``model.zip`` is SB3's own file, which can execute anything when it is read: only resume what you trust.

    :param folder: as given to :class:`CheckpointCPMCallback`
    :param env: like the one that the run had: same spaces, same number of environments, same wrappers; a ``VecNormalize`` gets
        its statistics back
    :param callback: made as the run's was; needed for a ``GAILCallback``, and for a ``ChallengerCallback`` that had a function
        or a class as argument, which no file holds
    :param device: PyTorch device; "auto" for both: a GPU if there is one
    :param model_class: only needed where it cannot be imported by its name
    :param custom_objects: SB3's: attributes of the model, ``{"policy_class": MyPolicy}``, that cannot be read here
    :return: the model, and its callback; a Dreamer, or a run without challenger, has None in its place
    :raises ValueError: if there is no whole checkpoint, or it belongs to another environment; the message has the cure
    """
    folder = Path(folder)
    checkpoint = checkpoints.find_checkpoint(folder)
    if checkpoint is None:
        raise ValueError(_what_is_there(folder))
    with Archive(checkpoint / checkpoints.STATE, "checkpoint") as archive:
        content = archive.content
    extra = unpack(content["extra"])
    if "exact" not in extra:
        raise ValueError(f"{checkpoint} was not made by CheckpointCPMCallback: what made it has to go on from it.")
    kind = _class_of(content["model_class"], checkpoint) if model_class is None else model_class
    venv = kind._wrap_env(env, verbose=0)
    _check_env(checkpoint, _attributes(checkpoint / checkpoints.MODEL, custom_objects), content, venv)
    callbacks = _made_again(checkpoint, content, callback, device)
    model = kind.load(checkpoint / checkpoints.MODEL, venv, device=device, custom_objects=custom_objects)
    if model.seed is not None:  # not once more the start states that the run began with
        venv.seed(checkpoints.seed_at(model.num_timesteps, model.seed, model.n_envs))
    checkpoints.restore(checkpoint, model, callbacks)
    if not extra["exact"]:  # there the callback begins new episodes, here learn() does
        model._last_obs = None
    restore_random_state(unpack(content["random"]), model.action_space)
    return model, callbacks[0] if callbacks else None


def _what_is_there(folder: Path) -> str:
    """Instead of a checkpoint."""
    wanted = f"There is no checkpoint in {folder}"
    if not folder.is_dir():
        return f"{wanted}: there is no such folder."
    names = sorted(path.name for path in folder.iterdir())
    if checkpoints.STATE in names:
        return f"{folder} is the checkpoint itself, expected is the folder that it is in: resume({str(folder.parent)!r}, env)."
    half = [name for name in names if name.split(".")[0] == checkpoints.NAME]
    if half:
        return (
            f"{wanted}, only half a one, {half[0]}, without {checkpoints.STATE}: it was being written when the process ended, "
            "or was copied in part. Begin the run anew."
        )
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    models = " A model that SB3 has saved is loaded with its class, SAC.load(path, env=env)." if ".zip" in shown else ""
    return f"{wanted}, as CheckpointCPMCallback(save_freq, folder) makes it; it holds {shown or 'nothing'}.{models}"


def _class_of(name: str, checkpoint: Path) -> type[BaseAlgorithm]:
    module, _, qualified = name.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in qualified.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"The model of {checkpoint} is of the class {qualified} of {module}, which cannot be imported here ({error}). "
            f"Install or add what it is in, or give it: resume(folder, env, model_class={qualified.rpartition('.')[2]})."
        ) from error
    return found


def _attributes(path: Path, custom_objects: dict[str, Any] | None) -> dict[str, Any]:
    """
    What SB3 has stored of a model besides its weights.

    :raises ValueError: naming what cannot be read here, with the cure
    """
    cure = "Make it importable here, or give it: resume(folder, env, custom_objects={})."
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            data, _, _ = load_from_zip_file(path, device="cpu", custom_objects=custom_objects)
    except ImportError as error:
        told = cure.format('{"policy_class": MyPolicy}, if that is what it is')
        raise ValueError(f"{path} has a part in the module {error.name!r}, which is not here ({error}). {told}") from error
    for warning in caught:
        found = re.search(r"Could not deserialize object (\w+)\..*Exception: (.*)", str(warning.message), re.DOTALL)
        if found is not None:
            told = cure.format(f'{{"{found[1]}": ...}}')
            raise ValueError(f"The {found[1]} of {path} cannot be read here ({found[2].strip()}). {told}")
    assert data is not None
    return data


def _check_env(checkpoint: Path, data: dict[str, Any], content: dict[str, Any], env: VecEnv) -> None:
    for name in ("observation_space", "action_space"):
        saved, here = data[name], getattr(env, name)
        if saved != here:
            raise ValueError(
                f"{checkpoint} was made in another environment: its {name.replace('_', ' ')} is {saved}, that of `env` is "
                f"{here}."
            )
    if data["n_envs"] != env.num_envs:
        raise ValueError(
            f"{checkpoint} was made in {data['n_envs']} environments, `env` has {env.num_envs}: the buffer has a column for "
            f"each. Give it {data['n_envs']}, make_vec_env(..., n_envs={data['n_envs']})."
        )
    was, is_now = "normalization" in content, unwrap_vec_normalize(env) is not None
    if was != is_now:
        told = "VecNormalize(env, ...), with the arguments it had" if was else "the environment without VecNormalize"
        raise ValueError(f"{checkpoint} was made {'with' if was else 'without'} a VecNormalize: give it {told}.")


def _made_again(
    checkpoint: Path, content: dict[str, Any], callback: BaseCallback | None, device: th.device | str
) -> list[BaseCallback]:
    """:return: the callback of the run, whose state is yet to come, or nothing if it had none"""
    saved, others = content["challengers"], content.get("callbacks", {})
    if others:
        name = " and ".join(["ChallengerCallback"] * len(saved) + sorted(others.values()))
        if len(saved) + len(others) > 1:
            raise ValueError(f"{checkpoint} was made with {name}, and resume() goes on with one callback.")
        if type(callback).__name__ != name:
            raise ValueError(
                f"{checkpoint} was made with a {name}: make it once more as it was, resume(folder, env, callback={name}(...))."
            )
        assert callback is not None
        return [callback]
    if not saved:
        if callback is not None:
            raise ValueError(f"{checkpoint} was made without a challenger: leave out `callback`.")
        return []
    if callback is not None:
        return [callback]
    entry = saved["0"]
    if entry["not stored"]:
        raise ValueError(
            f"The ChallengerCallback of {checkpoint} was given a function or class as {' and '.join(entry['not stored'])}, "
            "which no file holds: make it once more as it was, resume(folder, env, callback=ChallengerCallback(...))."
        )
    arguments = {name: unpack(value) for name, value in entry["arguments"].items()}
    arguments.update(load_path=None, device=arguments["device"] if device == "auto" else device)
    return [ChallengerCallback(**arguments)]
