"""
Misspelt keys in a configuration, found before anything is built and told with the nearest that exists.

rl_zoo3 hands everything that it does not know to constructors: a misspelt key is a TypeError after the environments are
made, with ``-i`` nothing at all. What is checked: the keys of an entry; arguments of callbacks, wrappers, replay buffer,
policy and features extractor, and those within ours (presets, uncertainty, decay, challenges); ``env_kwargs`` of our tasks;
and names of environments that do not exist.
"""

import importlib
import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cpm.agents.algorithms import algorithms, evaluated
from sb3_cpm.agents.configs import NAMED
from sb3_cpm.agents.tasks import NAMESPACE
from sb3_cpm.arguments import (
    AT_LEAST_0,
    SHARE,
    Rule,
    argument_names,
    check,
    check_arguments,
    check_names,
    error_prefix,
    integer,
    nearest,
    number,
)
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.buffers.checks import SET_BY_ALGORITHMS, check_values
from sb3_cpm.buffers.cpm_buffer import ONE_STEP
from sb3_cpm.challenges import ChallengeCurator
from sb3_cpm.dreamer.algorithm import DreamerAlgorithm
from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.presets import make_preset
from sb3_cpm.uncertainty import check_uncertainties, choose_uncertainty

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

#: What the keys that are numbers must be, whatever the algorithm. ``n_timesteps`` may be a float, as 1.0e+6 is one to YAML.
NUMBERS: dict[str, Rule] = {
    **{
        key: number("a whole number of at least 1", lambda value: value >= 1 and value.is_integer())
        for key in ("n_timesteps",)
    },
    **{key: integer(1) for key in ("n_envs", "buffer_size", "batch_size", "frame_stack")},
    "learning_starts": integer(0),
    "gradient_steps": integer(-1),
    **{key: SHARE for key in ("gamma", "tau")},
    "noise_std": AT_LEAST_0,
}

#: What YAML 1.1 takes for text, though whoever wrote it meant a number: 1e4, 3e-4, 1.0e2.
EXPONENT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)[eE][+-]?\d+")

#: Arguments that algorithms give to policies themselves.
SET_FOR_POLICIES = ("observation_space", "action_space", "lr_schedule")


def check_hyperparameters(hyperparameters: Mapping[str, Any], algo: str, env_id: str, path: str | Path) -> None:
    """
    :param hyperparameters: an entry of a file
    :param algo: rl_zoo3's name of the algorithm
    :param env_id: the environment that is asked for
    :param path: of the file, for the message
    :raises ValueError: for keys and arguments that nobody takes, naming the nearest; if policy or n_timesteps is missing; for
        policies of other algorithms, and for values that our callback, buffer and presets refuse
    """
    where = f"{path}, {env_id}"
    algorithm = algorithms()[algo]
    arguments = (argument_names(algorithm) or set()) - {"env", "seed", "device"}
    check_names(where, hyperparameters, {*arguments, *ZOO_KEYS})
    missing = {key for key in ("policy", "n_timesteps") if hyperparameters.get(key) is None}
    if missing:
        raise ValueError(f"{where}: {' and '.join(sorted(missing))} must be there.")
    _check_numbers(hyperparameters, where)
    for key in NAMED:
        with error_prefix(f"{where}, {key}"):
            named = named_with_arguments(hyperparameters.get(key))
        for name, kwargs in named:
            _check_made_of(_imported(name, f"{where}, {key}"), kwargs, f"{where}, {key} {name}")
    _check_buffer(hyperparameters, algorithm, where)
    policy_kwargs = evaluated(hyperparameters.get("policy_kwargs"), f"{where}, policy_kwargs")
    _check_policy_kwargs(policy_kwargs, _policy(hyperparameters["policy"], algo, where), f"{where}, policy_kwargs")
    if issubclass(algorithm, DreamerAlgorithm):
        _check_world_model({**hyperparameters, **(policy_kwargs or {})}, where)
    _check_env_kwargs(hyperparameters.get("env_kwargs"), env_id, f"{where}, env_kwargs")


def _check_numbers(hyperparameters: Mapping[str, Any], where: str) -> None:
    """
    :raises ValueError: for numbers that YAML takes for text, at any depth, and for those that no algorithm can work with
    """
    for key, value in hyperparameters.items():
        rule = NUMBERS.get(key)
        if isinstance(value, str) and _is_number(value):
            whole = rule is not None and not rule.holds(0.5)
            words = "a number" if rule is None else rule.words
            check(f"{where}: {key}", value, Rule(words, lambda value: isinstance(value, int if whole else float)))  # noqa: B023
        elif rule is not None and value is not None:
            check(f"{where}: {key}", value, rule)
        else:
            _check_nested(f"{where}: {key}", value)


def _check_nested(name: str, value: Any) -> None:
    """Deeper down a number in quotes may be meant as text, an exponent is not."""
    if isinstance(value, str) and EXPONENT.fullmatch(value.strip()):
        check(name, value, number("a number", lambda value: True))
    elif isinstance(value, Mapping):
        for key, part in value.items():
            _check_nested(f"{name}, {key}", part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            _check_nested(name, part)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def named_with_arguments(named: Any) -> list[tuple[str, dict[str, Any]]]:
    """
    What rl_zoo3 takes for callbacks and wrappers, in one form.

    >>> named_with_arguments(["a.B", {"c.D": {"e": 1}}])
    [('a.B', {}), ('c.D', {'e': 1})]

    :param named: a dotted path, ``{path: arguments}``, a list of these, or None
    :raises ValueError: for arguments that are no mapping
    """
    items = named if isinstance(named, list) else [named]
    pairs: list[tuple[str, dict[str, Any]]] = []
    for item in items:
        if isinstance(item, str):
            pairs.append((item, {}))
        elif isinstance(item, Mapping):
            for path, kwargs in item.items():
                if not isinstance(kwargs, Mapping):
                    raise ValueError(f"the arguments of {path} must be a mapping, got {kwargs!r}: write {{}} for none.")
                pairs.append((str(path), dict(kwargs)))
    return pairs


def _check_made_of(taker: Callable[..., Any], kwargs: Mapping[str, Any], where: str) -> None:
    check_arguments(where, kwargs, taker)
    if isinstance(taker, type) and issubclass(taker, BaseCallback) and taker.__module__.startswith("sb3_cpm."):
        with error_prefix(where):
            taker(**kwargs)  # ours check their arguments, and make nothing before learn()


def _check_buffer(hyperparameters: Mapping[str, Any], algorithm: type[BaseAlgorithm], where: str) -> None:
    kind = evaluated(hyperparameters.get("replay_buffer_class"), f"{where}, replay_buffer_class")
    where = f"{where}, replay_buffer_kwargs"
    kwargs = evaluated(hyperparameters.get("replay_buffer_kwargs"), where) or {}
    if kind is None:
        kind = CPMBuffer if issubclass(algorithm, DreamerAlgorithm) else ReplayBuffer
    check_arguments(where, kwargs, kind, excluded=SET_BY_ALGORITHMS)
    if isinstance(kind, type) and issubclass(kind, CPMBuffer):
        if issubclass(algorithm, OffPolicyAlgorithm) and (hyperparameters.get("n_steps") or 1) > 1:
            raise ValueError(f"{where}: {ONE_STEP}")
        arguments = {**_defaults(CPMBuffer), **kwargs}
        with error_prefix(where):
            for part in (check_values, ChallengeCurator):
                part(**{name: arguments[name] for name in inspect.signature(part).parameters})


def _policy(policy: Any, algo: str, where: str) -> Any:
    """:return: the class"""
    aliases = algorithms()[algo].policy_aliases
    if isinstance(policy, str) and "." not in policy:
        if policy not in aliases:
            raise ValueError(
                f"{where}: {algo} has no policy {policy!r}.{nearest(policy, aliases)} Valid: {', '.join(aliases)}, or a class "
                "with its module, as sb3_cpm.PointNetPolicy."
            )
        return aliases[policy]
    kind = _imported(policy, f"{where}, policy") if isinstance(policy, str) else policy
    if not isinstance(kind, type):
        raise ValueError(f"{where}: policy must be a name ({', '.join(aliases)}) or a class with its module, got {policy!r}.")
    others = [other for other, one in algorithms().items() if _is_policy_of(one, kind)]
    if others and algo not in others:
        raise ValueError(
            f"{where}: {policy} is a policy of {', '.join(others)}, not of {algo}, which has {', '.join(aliases)}. For point "
            'clouds take policy: MultiInputPolicy and policy_kwargs: "dict(features_extractor_class=PointNetExtractor)".'
        )
    return kind


def _is_policy_of(algorithm: type[BaseAlgorithm], policy: Any) -> bool:
    return isinstance(policy, type) and issubclass(policy, tuple(algorithm.policy_aliases.values()))


def _check_policy_kwargs(kwargs: Any, policy: Callable[..., Any], where: str) -> None:
    check_arguments(where, kwargs, policy, excluded=SET_FOR_POLICIES)
    kwargs, key = kwargs or {}, "features_extractor_class"
    extractor = kwargs.get(key) or getattr(policy, "default_extractor", None) or _defaults(policy).get(key)
    if isinstance(extractor, str):
        raise ValueError(
            f"{where}: features_extractor_class must be a class, got {extractor!r}. Write policy_kwargs as Python, in quotes: "
            f'"dict(features_extractor_class={extractor.rpartition(".")[-1]})".'
        )
    if extractor is not None:
        where = f"{where}, features_extractor_kwargs"
        check_arguments(where, kwargs.get("features_extractor_kwargs"), extractor, excluded=("observation_space",))


def _defaults(taker: Callable[..., Any]) -> dict[str, Any]:
    return {name: parameter.default for name, parameter in inspect.signature(taker).parameters.items()}


def _check_world_model(given: Mapping[str, Any], where: str) -> None:
    with error_prefix(where):
        preset = make_preset(given.get("preset") or "default")
        # that of the one to start from is not known here
        kind = given.get("uncertainty_class") or (None if given.get("start_from") else "plan2explore")
        if kind is None:
            check_uncertainties(preset)
        else:
            choose_uncertainty(kind, given.get("uncertainty_kwargs"), preset)


def _check_env_kwargs(given: Any, env_id: str, where: str) -> None:
    if given is None or not (env_id.startswith(NAMESPACE) or env_id == "CPMToy-v0"):
        return
    if env_id == "CPMToy-v0":
        check_names(where, given, {*(argument_names(ToyEnv) or ()), "max_episode_steps", "disable_env_checker"})
        return
    from sb3_cpm.envs import make_maniskill_env

    # what our tasks do not know they pass on to ManiSkill, so only what looks like one of our arguments is refused
    known = [name for name in inspect.signature(make_maniskill_env).parameters if name != "task_kwargs"]
    for key in given:
        guess = nearest(str(key), known, cutoff=0.75)
        if key not in known and guess:
            raise ValueError(f"{where}: unknown key {key!r}.{guess}")


def _imported(path: str, where: str) -> Callable[..., Any]:
    module_name, _, name = path.rpartition(".")
    if not module_name:
        raise ValueError(f"{where}: {path!r} must begin with its module, as sb3_cpm.ChallengerCallback does.")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(f"{where}: cannot import {path!r} ({error}).") from error
    if not hasattr(module, name):
        raise ValueError(f"{where}: {module_name} has no {name!r}.{nearest(name, dir(module))}")
    return getattr(module, name)
