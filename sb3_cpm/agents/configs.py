"""Files of ``zoo_configs/``: hyperparameters by environment, one file for each agent."""

import copy
import difflib
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_cpm.agents.tasks import ENV_IDS, NAMESPACE
from sb3_cpm.arguments import nearest
from sb3_cpm.extras import config_folder, needed

with needed("Configurations", "zoo"):
    import yaml


def find_config(name_or_path: str | Path) -> Path:
    """
    :param name_or_path: a name in ``zoo_configs/``, or a path
    :return: the file
    :raises ValueError: if there is none, with the nearest name
    """
    given = Path(name_or_path)
    if given.suffix in (".yml", ".yaml"):
        if given.is_file():
            return given
        raise ValueError(f"There is no file {given}. {_where()}")
    folder = config_folder()
    names = sorted(path.stem for path in folder.glob("*.yml"))
    if str(name_or_path) not in names:
        raise ValueError(f"Unknown agent {str(name_or_path)!r}.{nearest(str(name_or_path), names)} Known: {', '.join(names)}.")
    return folder / f"{name_or_path}.yml"


def _where() -> str:
    return f"The files of our agents are in {config_folder()}."


def read_entries(path: Path) -> dict[str, Any]:
    """
    :param path: a YAML file
    :return: hyperparameters by environment
    :raises ValueError: if it is no such file, or names a task of ours that does not exist
    """
    try:
        entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    if not isinstance(entries, dict):
        raise ValueError(f"{path}: expected hyperparameters by environment, got {type(entries).__name__}.")
    for name in map(str, entries):
        if name.startswith(NAMESPACE) and name not in ENV_IDS:
            raise ValueError(f"{path}: there is no environment {name!r}.{nearest(name, ENV_IDS)}")
    return entries


def check_environment_names(config: str, env_id: str) -> None:
    """
    :param config: what rl_zoo3 was given as ``--conf-file``; only YAML files are looked at
    :param env_id: the environment that is asked for
    :raises ValueError: see :func:`read_entries`; and if the environment is not in the file and there is no default for it
    """
    path = Path(config)
    if path.suffix not in (".yml", ".yaml"):
        return
    if not path.is_file():
        raise ValueError(f"There is no file {path}: name one with --conf-file. {_where()}")
    find_entry(read_entries(path), env_id, path)


def find_entry(entries: Mapping[str, Any], env_id: str, path: Path) -> dict[str, Any]:
    """
    :param entries: of the file
    :param env_id: the environment that is asked for
    :param path: of the file
    :return: the environment's entry, or the one called "default"
    :raises ValueError: if there is none, or it is no mapping
    """
    if env_id not in entries and not {"default", "atari"} & set(entries):
        others = ", ".join(map(repr, entries))
        raise ValueError(f"{path} has neither an entry {env_id!r} nor a default.{nearest(env_id, entries)} It has {others}.")
    if env_id not in entries:
        _warn_of_slip(env_id, entries, path)
    found = entries.get(env_id, entries.get("default", entries.get("atari")))
    if not isinstance(found, dict):
        raise ValueError(f"{path}: the entry of {env_id} must be a mapping of hyperparameters, got {found!r}.")
    return found


def _warn_of_slip(env_id: str, entries: Iterable[str], path: Path) -> None:
    """A misspelt name in a file is passed over for the default without a word; another version's would not be a slip."""
    name = env_id.rpartition("-v")[0]
    others = {other.rpartition("-v")[0]: other for other in map(str, entries) if other not in gym.registry}
    matches = difflib.get_close_matches(name, [other for other in others if other != name], n=1, cutoff=0.9)
    if matches:  # no error: the entry may belong to a package that is not imported here
        warnings.warn(
            f"{path} has no entry for {env_id!r}, which gets the default. Its entry {others[matches[0]]!r} names no "
            f"environment that is registered: did you mean {env_id!r}?",
            stacklevel=4,
        )


#: Keys whose values are classes by name, each perhaps with arguments; or a list of such.
NAMED = ("callback", "env_wrapper", "vec_env_wrapper")


def merge(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param base: is not changed
    :param overrides: dicts are merged entry by entry, everything else replaces; None removes. A dict over a list of callbacks
        or wrappers gives arguments to those that it names, and leaves the others
    :return: both
    """
    result = copy.deepcopy(dict(base))
    for key, value in overrides.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merge(result[key], value)
        elif isinstance(value, Mapping) and isinstance(result.get(key), list) and key in NAMED:
            result[key] = _merge_named(result[key], value)
        elif value is None:
            result.pop(key, None)
        else:
            result[key] = copy.deepcopy(value)
    return result


def _merge_named(base: list[Any], overrides: Mapping[str, Any]) -> list[Any]:
    """:return: the list, with arguments for those that are in it, and then those that are not"""
    result, new = [], dict(overrides)
    for one in base:
        named = {one: {}} if isinstance(one, str) else one
        changes = {name: overrides[name] for name in named if name in overrides}
        result.append(merge(named, changes) if changes else one)
        for name in changes:
            new.pop(name, None)
    result += [{name: arguments} for name, arguments in new.items() if arguments is not None]
    return [one for one in result if one]  # an empty one was removed
