"""
The folder of one run: who may write there, and what its state is.

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
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_cpm import __version__
from sb3_cpm.experiments.specification import RunSpec, fingerprint
from sb3_cpm.files import LockedError, locked, write_text
from sb3_cpm.run.folder import versions, write_yaml
from sb3_cpm.run.settings import FIRST_SEED

if TYPE_CHECKING:
    from sb3_cpm.agents import Agent

CONFIG, FINISHED, CRASHED = "config.yml", "finished.yml", "crashed.txt"


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
    if spec.eval_seed != FIRST_SEED:  # not otherwise: results of the time before there was a choice keep their fingerprint
        protocol["eval_seed"] = spec.eval_seed
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
        if path.parent.name == "zoo_configs":  # within the package in a wheel only, and no code
            continue
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
