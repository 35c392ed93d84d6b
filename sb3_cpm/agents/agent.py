"""
Agents by name: a file of ``zoo_configs/`` becomes a model with its callback and its environments.

rl_zoo3 reads the same files (``python -m rl_zoo3.train --algo sac --conf-file zoo_configs/cpm_sac.yml --gym-packages
sb3_cpm.zoo``), so its own :class:`~rl_zoo3.exp_manager.ExperimentManager` does the reading here too: schedules, wrappers,
normalization and action noise follow its rules. What is added: keys are checked before anything is built, entries can be
overridden in depth, and nothing is written.
"""

import argparse
import contextlib
import copy
import functools
import io
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cpm.agents.algorithms import add_names, algorithm_of, algorithms
from sb3_cpm.agents.checks import check_hyperparameters
from sb3_cpm.agents.configs import find_config, find_entry, merge, read_entries
from sb3_cpm.agents.tasks import can_render, ensure_registered
from sb3_cpm.envs.robust import RobustSubprocVecEnv


class Built(NamedTuple):
    """
    What :meth:`Agent.build` makes.

    :param model: the SB3 model
    :param callbacks: those of the configuration, in its order; empty where it names none
    :param env: the training environments of the model
    :param make_eval_env: makes one further environment with the same wrappers, in a ``DummyVecEnv`` of its own; with
        ``render=True`` one that gives pictures, where it can
    """

    model: BaseAlgorithm
    callbacks: list[BaseCallback]
    env: VecEnv
    make_eval_env: Callable[..., VecEnv]


@dataclass(frozen=True)
class Agent:
    """
    An algorithm with its hyperparameters on one environment. Use :func:`load_agent` to get one.

    :param name: of its file, without the suffix
    :param algo: rl_zoo3's name of the algorithm
    :param env_id: a registered gymnasium id
    :param hyperparameters: plain data, as rl_zoo3 reads it
    :param path: of its file
    """

    name: str
    algo: str
    env_id: str
    hyperparameters: dict[str, Any]
    path: Path

    @property
    def n_timesteps(self) -> int:
        """Length of a run in environment steps."""
        return int(float(self.hyperparameters["n_timesteps"]))

    @property
    def n_envs(self) -> int:
        """Number of parallel environments."""
        return int(self.hyperparameters.get("n_envs", 1))

    def build(
        self,
        seed: int,
        n_envs: int | None = None,
        device: str = "auto",
        vec_env_type: str = "dummy",
        load_path: str | Path | None = None,
    ) -> Built:
        """
        Make environments and model.

        :param seed: rules model and environments
        :param n_envs: parallel environments; None: as the configuration says
        :param device: PyTorch device
        :param vec_env_type: ``"dummy"``, ``"subproc"``, or ``"robust"``: in processes of their own, of which one that dies is
            replaced
        :param load_path: go on with this saved model instead of making a new one
        :return: model, callbacks and environments
        :raises ValueError: where the algorithm, a wrapper or the environment refuses its arguments
        """
        manager, hyperparameters = self._manager(seed, device, "dummy" if vec_env_type == "robust" else vec_env_type)
        if vec_env_type == "robust":
            manager.vec_env_class = functools.partial(_robust, seed)
        env = _quietly(manager.create_envs, n_envs or manager.n_envs, no_log=True)
        try:
            hyperparameters = _quietly(manager._preprocess_action_noise, hyperparameters, {}, env)
            algorithm = algorithms()[self.algo]
            if load_path is None:
                model = algorithm(env=env, seed=seed, device=device, **hyperparameters)
            else:
                model = algorithm.load(load_path, env=env, device=device)
        except AssertionError as error:  # that is how SB3 says it
            env.close()
            if "action spaces" not in str(error):
                raise
            raise ValueError(
                f"{self.env_id} has the action space {env.action_space}: {error}. Choose another agent."
            ) from error
        except BaseException:
            env.close()
            raise

        def make_eval_env(render: bool = False) -> VecEnv:
            manager.vec_env_class = DummyVecEnv
            if render and can_render(self.env_id):
                manager.eval_env_kwargs = {**manager.eval_env_kwargs, "render_mode": "rgb_array"}
            return _quietly(manager.create_envs, 1, eval_env=True, no_log=True)

        return Built(model, manager.callbacks, env, make_eval_env)

    def _manager(self, seed: int, device: str, vec_env_type: str) -> tuple[Any, dict[str, Any]]:
        """rl_zoo3's manager, and the arguments of the algorithm as it has read them."""
        add_names()
        from rl_zoo3 import exp_manager

        manager = _quietly(
            exp_manager.ExperimentManager,
            argparse.Namespace(),
            self.algo,
            self.env_id,
            log_folder="",
            seed=seed,
            verbose=0,
            vec_env_type=vec_env_type,
            device=device,
            config=str(self.path),
        )
        # it changes what it is given; and its own read_hyperparameters() would bring back entries that were removed
        hyperparameters, manager.env_wrapper, manager.callbacks, manager.vec_env_wrapper = _quietly(
            manager._preprocess_hyperparams, copy.deepcopy(self.hyperparameters)
        )
        manager.eval_env_kwargs = manager.env_kwargs  # what came from the file, too
        return manager, hyperparameters


def load_agent(name_or_path: str | Path, env_id: str, overrides: Mapping[str, Any] | None = None) -> Agent:
    """
    Read an agent's hyperparameters for an environment.

    >>> load_agent("cpm_sac", "MountainCarContinuous-v0", {"gamma": 0.99, "policy_kwargs": {"net_arch": [64]}}).algo
    'sac'

    :param name_or_path: of a file in ``zoo_configs/``, without the suffix, or the path of one
    :param env_id: a gymnasium id; an environment that the file does not name gets its entry ``default``
    :param overrides: entries that win over those of the file, dicts within dicts entry by entry; None removes an entry
    :return: the agent
    :raises ValueError: for names that do not exist, with the nearest that does; for files that are no such configuration
    """
    path = find_config(name_or_path)
    ensure_registered(env_id)
    entry = find_entry(read_entries(path), env_id, path)
    merged = merge(entry, overrides or {})
    algo = algorithm_of(path.stem)
    try:
        check_hyperparameters(merged, algo, env_id, path)
    except ValueError:
        if not overrides:
            raise
        check_hyperparameters(entry, algo, env_id, path)  # is it the file's fault?
        check_hyperparameters(merged, algo, env_id, f"What is given on top of {path.name}")
        raise
    return Agent(path.stem, algo, env_id, merged, path)


def _robust(seed: int, makers: Sequence[Callable[[], gym.Env]], **kwargs: Any) -> VecEnv:
    """
    :param seed: of the run
    :param makers: of the environments
    :param kwargs: of the class
    :return: them in processes of their own
    """
    seeded = [functools.partial(_in_a_worker, make, seed + rank) for rank, make in enumerate(makers)]
    return RobustSubprocVecEnv(seeded, **kwargs)


def _in_a_worker(make: Callable[[], gym.Env], seed: int) -> gym.Env:
    set_random_seed(seed)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main one ends this one
    return make()


def _quietly(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """rl_zoo3 prints what it reads; here that is in the run's config.yml."""
    with contextlib.redirect_stdout(io.StringIO()):
        return function(*args, **kwargs)
