"""
Four methods of rl_zoo3's ``ExperimentManager``, wrapped: what they did, they do, and then some.

==========================  ==============================================================================================
``read_hyperparameters``    also names misspelt keys, before anything is built (:mod:`sb3_cpm.agents.checks`), and puts our
                            part of a trial (``--trial-id``) where it belongs (:mod:`sb3_cpm.zoo.search`); evaluation
                            environments get the ``env_kwargs`` of the configuration, as training environments do
``_load_pretrained_agent``  also names the file where a replay buffer is damaged (:mod:`sb3_cpm.zoo.resume`)
``learn``                   also saves the challenger, and goes on where the run stopped with ``-i`` (likewise)
``objective``               also samples our arguments with ``--optimize`` (:mod:`sb3_cpm.zoo.search`)
==========================  ==============================================================================================
"""

import functools
from collections.abc import Callable
from typing import Any

from sb3_cpm.agents.checks import check_hyperparameters
from sb3_cpm.agents.configs import check_environment_names
from sb3_cpm.zoo import resume, search


def install() -> None:
    """Wrap the methods. Can be repeated."""
    from rl_zoo3.exp_manager import ExperimentManager

    wrappers = {
        "read_hyperparameters": _reading,
        "_load_pretrained_agent": _loading,
        "learn": _learning,
        "objective": _sampling,
    }
    for name, wrap in wrappers.items():
        method = getattr(ExperimentManager, name)
        if not hasattr(method, "__wrapped__"):
            setattr(ExperimentManager, name, functools.wraps(method)(wrap(method)))


def _reading(original: Callable[..., Any]) -> Callable[..., Any]:
    def read_hyperparameters(manager: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        check_environment_names(manager.config, manager.env_name.gym_id)
        configured = search.without_trial(original, manager)
        hyperparameters, _ = original(manager)
        if configured is not None:
            hyperparameters = search.with_trial(hyperparameters, configured, manager.custom_hyperparams or {})
        if manager._eval_env_kwargs_args is None and "env_kwargs" in hyperparameters:
            manager.eval_env_kwargs = hyperparameters["env_kwargs"]  # rl_zoo3 gives them to the training environments only
        check_hyperparameters(hyperparameters, manager.algo, manager.env_name.gym_id, manager.config)
        return hyperparameters, dict(sorted(hyperparameters.items()))

    return read_hyperparameters


def _loading(original: Callable[..., Any]) -> Callable[..., Any]:
    def _load_pretrained_agent(manager: Any, hyperparams: dict[str, Any], env: Any) -> Any:
        with resume.loading(manager, env):
            return original(manager, hyperparams, env)

    return _load_pretrained_agent


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
