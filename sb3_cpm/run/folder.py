"""
The folder of one run: its name, who may write there, and what its state is.

::

    config.yml        everything that the run was made with; fingerprint, versions
    evaluations.csv   one row per evaluation episode
    training.csv      one row per training episode
    diagnostics.csv   what was logged: step, name, value
    finished.yml      only when the run came to its end
    crashed.txt       the traceback of the last try, if that ended badly
    checkpoint/       while the run goes on
"""

import functools
import hashlib
import itertools
import os
import platform
import shutil
import sys
from contextlib import ExitStack, suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_cpm import __version__
from sb3_cpm.files import LOCK, LockedError, disk_errors_named, locked, write_text
from sb3_cpm.run.specification import RunSpec, fingerprint
from sb3_cpm.seeds import FIRST_SEED

if TYPE_CHECKING:  # whoever only reads results can do without
    from sb3_cpm.agents import Agent

CONFIG, FINISHED, CRASHED = "config.yml", "finished.yml", "crashed.txt"
#: Statistics of a VecNormalize, as SB3 and rl_zoo3 keep them.
NORMALIZATION = "vecnormalize.pkl"
PACKAGES = (
    "stable_baselines3",
    "sb3_contrib",
    "torch",
    "numpy",
    "gymnasium",
    "mani_skill",
    "sapien",
    "matplotlib",
)


class OtherResultError(ValueError):
    """A folder holds something else than what is asked for."""


def description(spec: RunSpec, agent: "Agent") -> dict[str, Any]:
    """:return: what ``config.yml`` holds: the protocol, its fingerprint, and the versions"""
    protocol = {
        "algo": agent.algo,
        "env_id": agent.env_id,
        "hyperparameters": agent.hyperparameters,
        "steps": spec.steps,
        "eval_every": spec.eval_every,
        "eval_episodes": spec.eval_episodes,
    }
    # only what differs: results of the time before there was a choice keep their fingerprint
    if spec.eval_seed != FIRST_SEED:
        protocol["eval_seed"] = spec.eval_seed
    if spec.checkpoint_every is not None:
        protocol["checkpoint_every"] = spec.checkpoint_every
    return {
        "run": spec.as_dict(),
        "protocol": protocol,
        "fingerprint": fingerprint(protocol),
        "sb3_cpm": __version__,
        "code": code_digest(),
        "versions": {name: version for name, version in versions().items() if name != "command"},
    }


@functools.cache
def code_digest() -> str:
    """:return: twelve characters that differ whenever a module of this package does: between releases the version does not"""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def read_yaml(path: Path) -> dict[str, Any]:
    """:raises ValueError: if it is no YAML mapping"""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: it holds no mapping. Remove its folder to run it again.")
    return content


def is_finished(folder: Path) -> bool:
    return (folder / FINISHED).exists()


def check_belongs(folder: Path, wanted: dict[str, Any]) -> str | None:
    """
    Does the folder hold results of what is asked for?

    :param folder: of the run
    :param wanted: its :func:`description`
    :return: None, or what is worth mentioning: the version that made it, if that is another one
    :raises OtherResultError: if other hyperparameters made it
    """
    if not (folder / CONFIG).exists():
        return None
    theirs = read_yaml(folder / CONFIG)
    if theirs.get("fingerprint") != wanted["fingerprint"]:
        changes = differences(theirs.get("protocol") or {}, wanted["protocol"])
        raise OtherResultError(
            f"{folder} holds a run with other settings ({'; '.join(changes[:4])}). Nothing is overwritten: choose "
            "another folder with --results, or remove that one yourself."
        )
    if theirs.get("sb3_cpm") != wanted["sb3_cpm"]:
        return f"made by sb3_cpm {theirs.get('sb3_cpm')}, this is {wanted['sb3_cpm']}"
    return None


def has_checkpoint(folder: Path) -> bool:
    """:return: whether there is a checkpoint to go on from, whole or not"""
    return any((folder / name / "model.zip").exists() for name in ("checkpoint", "checkpoint.old"))


def check_may_go_on(folder: Path, note: str | None) -> None:
    """
    :param folder: of an unfinished run
    :param note: what :func:`check_belongs` has to say of it
    :raises OtherResultError: if another version has begun it: half a run of each would be neither's result
    """
    if note is not None and has_checkpoint(folder):
        raise OtherResultError(f"{folder} holds an unfinished run {note}: finish it there, or remove it.")


def differences(theirs: dict[str, Any], ours: dict[str, Any], prefix: str = "") -> list[str]:
    """:return: ``"name: there 1, here 2"`` for every entry that differs, dicts entry by entry"""
    found: list[str] = []
    for key in sorted({*theirs, *ours}):
        there, here = theirs.get(key), ours.get(key)
        if isinstance(there, dict) and isinstance(here, dict):
            found += differences(there, here, f"{prefix}{key}.")
        elif there != here:
            found.append(f"{prefix}{key}: there {there!r}, here {here!r}")
    return found


def write_config(folder: Path, config: dict[str, Any]) -> None:
    write_yaml(folder / CONFIG, config)


def write_finished(folder: Path, facts: dict[str, Any]) -> None:
    write_yaml(folder / FINISHED, facts)
    remove_crashed(folder)


def write_crashed(folder: Path, text: str) -> bool:
    """
    :param folder: of the run; one that is finished or being written by another process is left as it is
    :param text: what happened
    :return: whether it was written
    """
    try:
        with locked(folder):
            if is_finished(folder):
                return False
            write_text(folder / CRASHED, text)
            return True
    except (LockedError, OSError):  # a full disk: what the crash was is told by whoever saw it
        return False


def remove_crashed(folder: Path) -> None:
    (folder / CRASHED).unlink(missing_ok=True)


# ---------------------------------------------------------------------- a folder of its own for one run


#: What a run may have written before its first step, so that a run that never took one takes it away again.
_BEFORE_THE_FIRST_STEP = (
    *(CONFIG, "evaluations.csv", "training.csv", "diagnostics.csv", "proposals.csv", "coefficients.csv"),
    *("checkpoint", "tensorboard", LOCK),
)


class NewFolder:
    """
    A folder for the results of one run that holds nothing yet, locked while that goes on.

    :param name: of the folder; None for the next free one below ``runs/``
    :param stem: what that begins with
    :raises ValueError: when the folder asked for already holds something
    :raises LockedError: while another process writes it
    :raises NotWrittenError: where no folder can be made
    """

    def __init__(self, name: str | None, stem: str) -> None:
        with disk_errors_named(name or "runs"):
            self.path, self._made = _next(stem) if name is None else _named(name)
        self._lock = ExitStack()
        self._lock.enter_context(locked(self.path))
        if any(entry.name != LOCK for entry in self.path.iterdir()):
            self.release()
            raise ValueError(_not_empty(self.path))

    def release(self) -> None:
        """The run has ended."""
        self._lock.close()

    def discard(self) -> None:
        """Take away what a run that took no step has written, and the folder, if it was made for it. Nothing else."""
        for name in _BEFORE_THE_FIRST_STEP:
            path = self.path / name
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        self.release()
        if self._made:
            with suppress(OSError):  # somebody else has put something there
                self.path.rmdir()


def _named(name: str) -> tuple[Path, bool]:
    """:return: the folder, and whether it was not there before"""
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise ValueError(_not_empty(folder))
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return folder, False
    return folder, True


def _next(stem: str) -> tuple[Path, bool]:
    """:return: the next free folder below ``runs/``, and that it was not there before"""
    for number in itertools.count(1):
        folder = Path("runs") / (stem if number == 1 else f"{stem}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder, True


def _not_empty(folder: Path) -> str:
    return (
        f"The run folder {folder} exists and is not empty. Nothing is ever overwritten: choose another name with "
        f"--run-folder, leave it out to get the next free name, or remove {folder} yourself. A run that was cut off goes on "
        f"with --resume {folder}."
    )


def write_yaml(path: Path, data: dict[str, Any]) -> None:
    write_text(path, yaml.safe_dump(data, sort_keys=False))


def versions() -> dict[str, Any]:
    """:return: what the run was made with"""
    found: dict[str, Any] = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }
    found["sb3_cpm"] = __version__
    return {**found, **{package: _version(package) for package in PACKAGES}}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
