"""The folder that a run leaves: names that are never taken twice, and files that are complete or not there."""

import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from sb3_cpm import __version__
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


def make_run_folder(settings: TrainSettings) -> Path:
    """
    Make a new folder for the results.

    :param settings: of the run
    :return: ``settings.run_folder``, or else the next free name below ``runs/``
    :raises ValueError: when the folder asked for already holds something
    """
    if settings.run_folder is not None:
        folder = Path(settings.run_folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(
                f"The run folder {folder} exists and is not empty. Nothing is ever overwritten: choose another name with "
                f"--run-folder, leave it out to get the next free name, or remove {folder} yourself."
            )
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    name = f"{settings.env.rpartition(':')[2].replace('/', '-')}-{settings.algorithm}-seed{settings.seed}"
    number = 1
    while True:
        folder = Path("runs") / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """
    Give a temporary path beside ``path`` (with the same suffix), and rename it once everything is written.

    :param path: the file to write or replace
    """
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


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
