"""
Misspelt keys in a configuration, found before anything is built and told with the nearest that exists.

rl_zoo3 hands everything that it does not know to constructors: a misspelt key is a TypeError after the environments are
made, with ``-i`` nothing at all. What is checked: the keys of an entry; arguments of callbacks, wrappers, replay buffer and
policy as far as they are written as mappings; ``env_kwargs`` of our tasks; and names of environments that do not exist.
"""

import difflib
import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cpm.presets import nearest
from sb3_cpm.zoo.registration import ENV_IDS, NAMESPACE

#: Keys that rl_zoo3 takes for itself; all others go to the constructor of the algorithm.
ZOO_KEYS = (
    "n_timesteps",
    "n_envs",
    "env_kwargs",
    "env_wrapper",
    "vec_env_wrapper",
    "normalize",
    "frame_stack",
    "callback",
    "monitor_kwargs",
    "noise_type",
    "noise_std",
)


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """:return: rl_zoo3's algorithms by name, ours included"""
    from rl_zoo3.utils import ALGOS

    return ALGOS


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
    :raises ValueError: see :func:`read_entries`; and if the environment is not in the file, there is no default for it, or the
        name is so close to one that is there that one of them must be a slip
    """
    path = Path(config)
    if path.suffix not in (".yml", ".yaml"):
        return
    if not path.is_file():
        raise ValueError(f"There is no file {path}: name one with --conf-file.")
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
        _refuse_slip(env_id, entries, path)
    found = entries.get(env_id, entries.get("default", entries.get("atari")))
    if not isinstance(found, dict):
        raise ValueError(f"{path}: the entry of {env_id} must be a mapping of hyperparameters, got {found!r}.")
    return found


def _refuse_slip(env_id: str, entries: Iterable[str], path: Path) -> None:
    """A misspelt name in a file would be passed over for the default without a word; another version's would not be a slip."""
    name = env_id.rpartition("-v")[0]
    others = {other.rpartition("-v")[0]: other for other in map(str, entries) if other not in gym.registry}
    matches = difflib.get_close_matches(name, [other for other in others if other != name], n=1, cutoff=0.9)
    if matches:
        raise ValueError(f"{path} has an entry {others[matches[0]]!r}, which is no environment: did you mean {env_id!r}?")


def check_hyperparameters(hyperparameters: Mapping[str, Any], algo: str, env_id: str, path: str | Path) -> None:
    """
    :param hyperparameters: an entry of a file
    :param algo: rl_zoo3's name of the algorithm
    :param env_id: the environment that is asked for
    :param path: of the file, for the message
    :raises ValueError: for keys and arguments that nobody takes, naming the nearest; if policy or n_timesteps is missing
    """
    where = f"{path}, {env_id}"
    algorithm = algorithms()[algo]
    arguments = set(inspect.signature(algorithm.__init__).parameters) - {"self", "env", "seed", "device"}
    _check_names(hyperparameters, {*arguments, *ZOO_KEYS}, where)
    missing = {"policy", "n_timesteps"} - set(hyperparameters)
    if missing:
        raise ValueError(f"{where}: {' and '.join(sorted(missing))} must be there.")
    for key in ("callback", "env_wrapper", "vec_env_wrapper"):
        for name, kwargs in named_with_arguments(hyperparameters.get(key)):
            _check_arguments(kwargs, _imported(name, f"{where}, {key}"), f"{where}, {key} {name}")
    _check_arguments(
        hyperparameters.get("replay_buffer_kwargs"), _buffer_class(hyperparameters), f"{where}, replay_buffer_kwargs"
    )
    policy = hyperparameters["policy"]
    if isinstance(policy, str):
        policy = _imported(policy, f"{where}, policy") if "." in policy else algorithm.policy_aliases.get(policy)
    _check_arguments(hyperparameters.get("policy_kwargs"), policy, f"{where}, policy_kwargs")
    if env_id.startswith(NAMESPACE):
        _check_env_kwargs(hyperparameters.get("env_kwargs"), f"{where}, env_kwargs")


def named_with_arguments(named: Any) -> list[tuple[str, dict[str, Any]]]:
    """
    What rl_zoo3 takes for callbacks and wrappers, in one form.

    >>> named_with_arguments(["a.B", {"c.D": {"e": 1}}])
    [('a.B', {}), ('c.D', {'e': 1})]

    :param named: a dotted path, ``{path: arguments}``, a list of these, or None
    """
    items = named if isinstance(named, list) else [named]
    pairs: list[tuple[str, dict[str, Any]]] = []
    for item in items:
        if isinstance(item, str):
            pairs.append((item, {}))
        elif isinstance(item, Mapping):
            pairs += [(str(path), dict(kwargs or {})) for path, kwargs in item.items()]
    return pairs


def _check_names(given: Iterable[str], valid: Iterable[str], where: str) -> None:
    for key in given:
        if key not in valid:
            raise ValueError(f"{where}: unknown key {key!r}.{nearest(str(key), valid)} Valid: {', '.join(sorted(valid))}.")


def _check_arguments(given: Any, taker: Callable[..., Any] | None, where: str) -> None:
    """Strings are Python that rl_zoo3 evaluates, and some take anything by name: both are left alone."""
    if isinstance(given, Mapping) and taker is not None:
        valid = _parameters(taker)
        if valid is not None:
            _check_names(given, valid, where)


def _parameters(taker: Callable[..., Any]) -> set[str] | None:
    """:return: names of the arguments, of parents as far as they are passed on; None where there is no end of them"""
    functions = (
        [vars(kind)["__init__"] for kind in taker.__mro__ if "__init__" in vars(kind)] if isinstance(taker, type) else [taker]
    )
    names: set[str] = set()
    for function in functions:
        parameters = inspect.signature(function).parameters.values()
        names |= {parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD} - {"self"}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return names
    return None


def _check_env_kwargs(given: Any, where: str) -> None:
    """Our tasks pass what they do not know on to ManiSkill, so only what looks like one of our arguments is refused."""
    from sb3_cpm.envs import make_maniskill_env

    known = [name for name in inspect.signature(make_maniskill_env).parameters if name != "task_kwargs"]
    if not isinstance(given, Mapping):
        return
    for key in given:
        guess = nearest(str(key), known, cutoff=0.75)
        if key not in known and guess:
            raise ValueError(f"{where}: unknown key {key!r}.{guess}")


def _imported(path: str, where: str) -> Callable[..., Any]:
    module_name, _, name = path.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(f"{where}: cannot import {path!r} ({error}).") from error
    if not hasattr(module, name):
        raise ValueError(f"{where}: {module_name} has no {name!r}.{nearest(name, vars(module))}")
    return getattr(module, name)


def _buffer_class(hyperparameters: Mapping[str, Any]) -> Callable[..., Any] | None:
    from rl_zoo3 import exp_manager

    name = hyperparameters.get("replay_buffer_class")
    return vars(exp_manager).get(name) if isinstance(name, str) else name
