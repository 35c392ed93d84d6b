"""The folder that a run leaves: a name that is never taken twice, and one process that writes it."""

import itertools
import os
import platform
import shutil
import sys
from contextlib import ExitStack, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from sb3_cpm import __version__
from sb3_cpm.files import LOCK, disk_errors_named, locked, write_text
from sb3_cpm.run.settings import TrainSettings

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


#: What a run has written before its first step, so that a run that never took one takes it away again.
_BEFORE_THE_FIRST_STEP = (
    *("config.yml", "versions.yml", "progress.csv", "episodes.csv", "proposals.csv", "coefficients.csv", "evaluations.csv"),
    *("model.zip", "challenger.pt", "tensorboard", LOCK),
)


class RunFolder:
    """
    A folder for the results of one run, locked while that goes on.

    :param settings: of the run; ``run_folder`` names the folder, else it is the next free name below ``runs/``
    :raises ValueError: when the folder asked for already holds something
    :raises LockedError: while another process writes it
    :raises NotWrittenError: where no folder can be made
    """

    def __init__(self, settings: TrainSettings) -> None:
        with disk_errors_named(settings.run_folder or "runs"):
            self.path, self._made = _next(settings) if settings.run_folder is None else _named(settings.run_folder)
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


def _next(settings: TrainSettings) -> tuple[Path, bool]:
    """:return: likewise, of the next free name"""
    name = f"{settings.env.rpartition(':')[2].replace('/', '-')}-{settings.algorithm}-seed{settings.seed}"
    for number in itertools.count(1):
        folder = Path("runs") / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder, True


def _not_empty(folder: Path) -> str:
    return (
        f"The run folder {folder} exists and is not empty. Nothing is ever overwritten: choose another name with "
        f"--run-folder, leave it out to get the next free name, or remove {folder} yourself."
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
