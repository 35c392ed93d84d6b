"""
Search spaces for ``--optimize``: rl_zoo3's for the player, and ours for what CPM adds.

rl_zoo3 asks a function per algorithm for hyperparameters of a trial, replaces ``policy_kwargs`` and ``replay_buffer_kwargs``
by what it says, and has no place for arguments of callbacks. So our part is sampled around ``ExperimentManager.objective``, on
a copy of the manager (trials may run in threads), and ``policy_kwargs`` of the configuration stay where a trial is silent.
"""

import contextlib
import contextvars
import copy
import io
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from sb3_cpm.agents.algorithms import evaluated
from sb3_cpm.agents.checks import named_with_arguments
from sb3_cpm.callbacks import ChallengerCallback

#: Key under which the converter hands our part of a trial to :func:`with_trial`.
OURS = "cpm_trial"


class Argument(NamedTuple):
    """
    Something to search for.

    :param place: where its value goes: keys of ``replay_buffer_kwargs``, or of the arguments of ``ChallengerCallback``
    :param suggest: asks a trial for a value under a name
    """

    place: tuple[str, ...]
    suggest: Callable[[Any, str], Any]


def _number(low: float, high: float, log: bool = False) -> Callable[[Any, str], float]:
    return lambda trial, name: trial.suggest_float(name, low, high, log=log)


def _one_of(*values: Any) -> Callable[[Any, str], Any]:
    return lambda trial, name: trial.suggest_categorical(name, list(values))


BUFFER_SPACE = {
    "challenge_ratio": Argument(("challenge_ratio",), _number(0.05, 0.5)),
    "challenge_mix": Argument(("mix",), _one_of("batch", "row")),
    "max_challenges": Argument(("max_challenges",), _one_of(5, 10, 20, 50)),
}
"""What is searched for in ``CPMBuffer``, by the name that the trial shows."""

CALLBACK_SPACE = {
    "challenger_train_freq": Argument(("train_freq",), _one_of(10, 25, 50, 100)),
    "decay": Argument(("decay",), _one_of("linear", "exponential", "inverse_time", "cosine", "logistic")),
    "decay_start": Argument(("decay_kwargs", "start"), _number(0.3, 1.0)),
    "decay_floor": Argument(("decay_kwargs", "floor"), _number(0.01, 0.2, log=True)),
    "decay_rate": Argument(("decay_kwargs", "rate"), _number(1.0, 10.0, log=True)),
    "exploration_unit": Argument(("unit",), _one_of("step", "segment", "episode")),
}
"""What is searched for in ``ChallengerCallback``."""

PLAYERS = ("sac", "td3", "tqc", "ddpg", "rlpd")
"""Algorithms that can play against a challenger."""

WORLD_MODEL_SPACE = {
    "learning_rate": Argument(("learning_rate",), _number(1e-4, 3e-3, log=True)),
    "train_freq": Argument(("train_freq",), _one_of(2, 5, 10, 20)),
    "actor_lr": Argument(("preset", "actor_lr"), _number(3e-5, 1e-3, log=True)),
    "critic_lr": Argument(("preset", "critic_lr"), _number(3e-5, 1e-3, log=True)),
    "entropy_scale": Argument(("preset", "entropy_scale"), _number(1e-5, 1e-2, log=True)),
    "horizon": Argument(("preset", "horizon"), _one_of(8, 15, 25)),
    "gamma": Argument(("preset", "gamma"), _one_of(0.9, 0.95, 0.99, 0.997)),
    "free_nats": Argument(("preset", "free_nats"), _one_of(0.1, 1.0, 3.0)),
}
"""What is searched for in ``Dreamer`` and ``Plan2Explore``."""

#: Hyperparameters of the configuration while a trial of this thread is being made.
_configured: contextvars.ContextVar[Mapping[str, Any] | None] = contextvars.ContextVar("_configured", default=None)


def install() -> None:
    """Give our search spaces to rl_zoo3. Can be repeated."""
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    HYPERPARAMS_SAMPLER.setdefault("rlpd", HYPERPARAMS_SAMPLER["sac"])  # it is a SAC
    HYPERPARAMS_CONVERTER.setdefault("rlpd", HYPERPARAMS_CONVERTER["sac"])
    for algo in PLAYERS:
        if not hasattr(HYPERPARAMS_SAMPLER[algo], "of_player"):
            HYPERPARAMS_SAMPLER[algo] = _keeping_policy(HYPERPARAMS_SAMPLER[algo])
            HYPERPARAMS_CONVERTER[algo] = _setting_ours_apart(HYPERPARAMS_CONVERTER[algo])
    for algo in ("dreamer", "plan2explore"):
        HYPERPARAMS_SAMPLER[algo] = _sample_dreamer
        HYPERPARAMS_CONVERTER[algo] = _convert_dreamer


# ---------------------------------------------------------------------- the player's space, and ours beside it


def _keeping_policy(sample: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    def sample_player(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        sampled = sample(trial, n_actions, n_envs, additional_args)
        return _with_policy_kwargs(sampled, _configured.get() or {})

    sample_player.of_player = True  # type: ignore[attr-defined]
    return sample_player


def _setting_ours_apart(convert: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    def convert_player(parameters: dict[str, Any]) -> dict[str, Any]:
        ours = {name: value for name, value in parameters.items() if name in {**BUFFER_SPACE, **CALLBACK_SPACE}}
        theirs = {name: value for name, value in parameters.items() if name not in ours}
        return {**convert(theirs), **({OURS: ours} if ours else {})}

    return convert_player


def _with_policy_kwargs(sampled: dict[str, Any], configured: Mapping[str, Any]) -> dict[str, Any]:
    if "policy_kwargs" not in sampled:
        return sampled
    before = evaluated(configured.get("policy_kwargs"), "policy_kwargs") or {}
    return {**sampled, "policy_kwargs": {**before, **sampled["policy_kwargs"]}}


@contextlib.contextmanager
def sampled(manager: Any, trial: Any) -> Iterator[Any]:
    """
    Around ``ExperimentManager.objective``.

    :param manager: rl_zoo3's ``ExperimentManager``
    :param trial: Optuna's trial
    :return: the manager to use in its place
    """
    manager = copy.copy(manager)
    configured = {**manager._hyperparams, "callback": manager.specified_callbacks}
    if _challenger_index(configured["callback"]) is not None:
        space = {**BUFFER_SPACE, **CALLBACK_SPACE}
        configured = applied({name: argument.suggest(trial, name) for name, argument in space.items()}, configured)
    manager.specified_callbacks = configured.pop("callback")
    manager._hyperparams = configured
    token = _configured.set(configured)
    try:
        yield manager
    finally:
        _configured.reset(token)


def without_trial(read: Callable[[Any], Any], manager: Any) -> dict[str, Any] | None:
    """
    What the configuration says where ``--trial-id`` is about to replace some of it, in any form that rl_zoo3 reads.

    :param read: rl_zoo3's ``ExperimentManager.read_hyperparameters``
    :param manager: rl_zoo3's ``ExperimentManager``
    :return: hyperparameters without those of trial and command line; None where there is no trial
    """
    if not (manager.storage and manager.study_name and manager.trial_id):
        return None
    plain = copy.copy(manager)
    plain.trial_id = plain.custom_hyperparams = None
    with contextlib.redirect_stdout(io.StringIO()):  # rl_zoo3 prints what it reads
        hyperparameters, _ = read(plain)
    return copy.deepcopy(hyperparameters)  # that of an imported module is changed in place


def with_trial(
    hyperparameters: Mapping[str, Any], configured: Mapping[str, Any], command_line: Collection[str]
) -> dict[str, Any]:
    """
    Hyperparameters in which ``--trial-id`` has replaced some, with our part of the trial where it belongs.

    :param hyperparameters: what rl_zoo3 has read, trial and command line included
    :param configured: what the configuration alone says
    :param command_line: names of those that were given with ``-params``, which stay
    """
    merged = _with_policy_kwargs(dict(hyperparameters), configured)
    if isinstance(configured.get("preset"), dict) and isinstance(merged.get("preset"), dict):
        merged["preset"] = {**configured["preset"], **merged["preset"]}
    ours = merged.pop(OURS, {})
    return {**applied(ours, merged), **{name: hyperparameters[name] for name in command_line}}


def applied(values: Mapping[str, Any], hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """
    >>> applied({"challenge_ratio": 0.4}, {"replay_buffer_kwargs": {"mix": "row"}})["replay_buffer_kwargs"]
    {'mix': 'row', 'challenge_ratio': 0.4}

    :param values: of arguments in :data:`BUFFER_SPACE` and :data:`CALLBACK_SPACE`, by name
    :param hyperparameters: of the configuration, is not changed
    :return: both
    """
    result = dict(hyperparameters)
    of_buffer = {BUFFER_SPACE[name].place: value for name, value in values.items() if name in BUFFER_SPACE}
    of_callback = {CALLBACK_SPACE[name].place: value for name, value in values.items() if name in CALLBACK_SPACE}
    if of_buffer:
        before = evaluated(result.get("replay_buffer_kwargs"), "replay_buffer_kwargs") or {}
        result["replay_buffer_kwargs"] = _placed(before, of_buffer)
    index = _challenger_index(result.get("callback"))
    if of_callback and index is not None:
        callbacks = [{path: kwargs} for path, kwargs in named_with_arguments(result["callback"])]
        ((path, kwargs),) = callbacks[index].items()
        callbacks[index] = {path: _placed(kwargs, of_callback)}
        result["callback"] = callbacks
    return result


def _placed(kwargs: Mapping[str, Any], values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    result = copy.deepcopy(dict(kwargs))
    for (*parents, last), value in values.items():
        inner = result
        for parent in parents:
            inner = inner.setdefault(parent, {})
        inner[last] = value
    return result


def _challenger_index(callbacks: Any) -> int | None:
    """:return: which of the configured callbacks brings a challenger"""
    from rl_zoo3.utils import get_class_by_name

    for index, (path, _) in enumerate(named_with_arguments(callbacks)):
        kind = get_class_by_name(path)
        if isinstance(kind, type) and issubclass(kind, ChallengerCallback):
            return index
    return None


# ---------------------------------------------------------------------- Dreamer and Plan2Explore


def _sample_dreamer(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    converted = _convert_dreamer({name: argument.suggest(trial, name) for name, argument in WORLD_MODEL_SPACE.items()})
    preset = (_configured.get() or {}).get("preset")
    if isinstance(preset, str):
        from sb3_cpm.presets import make_preset

        preset = asdict(make_preset(preset))
    return {**converted, "preset": {**(preset or {}), **converted["preset"]}}


def _convert_dreamer(sampled_params: dict[str, Any]) -> dict[str, Any]:
    return _placed({}, {WORLD_MODEL_SPACE[name].place: value for name, value in sampled_params.items()})
