"""
Three methods of rl_zoo3's ``ExperimentManager``, wrapped: what they did, they do, and then some.

=========================  ===============================================================================================
``read_hyperparameters``   also names misspelt keys, before anything is built (:mod:`sb3_cpm.zoo.checks`), and puts our part of
                           a trial (``--trial-id``) where it belongs (:mod:`sb3_cpm.zoo.search`); evaluation environments get
                           the ``env_kwargs`` of the configuration, as training environments do
``learn``                  also saves the challenger, and goes on where the run stopped with ``-i`` (:mod:`sb3_cpm.zoo.resume`)
``objective``              also samples our arguments with ``--optimize`` (:mod:`sb3_cpm.zoo.search`)
=========================  ===============================================================================================
"""

import functools
from collections.abc import Callable
from typing import Any

from sb3_cpm.zoo import checks, resume, search


def install() -> None:
    """Wrap the methods. Can be repeated."""
    from rl_zoo3.exp_manager import ExperimentManager

    for name, wrap in (("read_hyperparameters", _reading), ("learn", _learning), ("objective", _sampling)):
        method = getattr(ExperimentManager, name)
        if not hasattr(method, "__wrapped__"):
            setattr(ExperimentManager, name, functools.wraps(method)(wrap(method)))


def _reading(original: Callable[..., Any]) -> Callable[..., Any]:
    def read_hyperparameters(manager: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        checks.check_environment_names(manager.config, manager.env_name.gym_id)
        hyperparameters, _ = original(manager)
        if configured is not None:
            hyperparameters = search.with_trial(hyperparameters, configured, manager.custom_hyperparams or {})
        if manager._eval_env_kwargs_args is None and "env_kwargs" in hyperparameters:
            manager.eval_env_kwargs = hyperparameters["env_kwargs"]  # rl_zoo3 gives them to the training environments only
        checks.check_hyperparameters(hyperparameters, manager.algo, manager.env_name.gym_id, manager.config)
        return hyperparameters, dict(sorted(hyperparameters.items()))

        configured = search.without_trial(original, manager)
    return read_hyperparameters


def _learning(original: Callable[..., Any]) -> Callable[..., Any]:
    def learn(manager: Any, model: Any) -> None:
        with resume.kept(manager, model) as model:
            original(manager, model)

    return learn


def _sampling(original: Callable[..., Any]) -> Callable[..., Any]:
    def objective(manager: Any, trial: Any) -> float:
        with search.sampled(manager, trial) as manager:
            return original(manager, trial)

    return objective
