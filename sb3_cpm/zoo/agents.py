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
import importlib.util
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

from sb3_cpm.arguments import nearest
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.envs.suites import register_suite
from sb3_cpm.zoo.checks import algorithms, check_hyperparameters, find_entry, read_entries
from sb3_cpm.zoo.registration import NAMESPACE, TASKS, knows_task, make_task, register_task


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
    merged = merge(find_entry(read_entries(path), env_id, path), overrides or {})
    algo = algorithm_of(path.stem)
    check_hyperparameters(merged, algo, env_id, path)
    return Agent(path.stem, algo, env_id, merged, path)


# ---------------------------------------------------------------------- names


def config_folder() -> Path:
    """
    :return: ``zoo_configs/`` of the checkout that this package is in, or else of the working directory
    :raises ValueError: where there is none
    """
    candidates = [Path(__file__).resolve().parents[2] / "zoo_configs", Path.cwd() / "zoo_configs"]
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise ValueError(f"No folder zoo_configs, neither in {candidates[0].parent} nor here: give the path of a file.")


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
        raise ValueError(f"There is no file {given}.")
    folder = config_folder()
    names = sorted(path.stem for path in folder.glob("*.yml"))
    if str(name_or_path) not in names:
        raise ValueError(f"Unknown agent {str(name_or_path)!r}.{nearest(str(name_or_path), names)} Known: {', '.join(names)}.")
    return folder / f"{name_or_path}.yml"


def algorithm_of(name: str) -> str:
    """
    The algorithm that a file is for: the one that is a part of its name.

    >>> algorithm_of("cpm_sac_report")
    'sac'

    :raises ValueError: if no part is one
    """
    known = algorithms()
    padded = f"_{name}_"
    matches = [algo for algo in known if f"_{algo}_" in padded]
    if not matches:
        raise ValueError(f"The name {name!r} contains no algorithm (one of {', '.join(known)}): rename the file, my_sac.yml.")
    return max(matches, key=len)  # ppo_lstm, not ppo


def imported(module: str, env_id: str) -> None:
    """
    gymnasium's ``MODULE:ID``: import what registers a task.

    :param module: its name; "" for nothing
    :param env_id: the task
    :raises ValueError: if there is no such module, or it does not register that
    """
    if not module:
        return
    try:
        importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise ValueError(f"env={module}:{env_id}: cannot import {module!r}, which should register {env_id!r} ({error})") from error
    if env_id not in gym.registry:
        raise ValueError(f"env={module}:{env_id}: {module} registers no {env_id!r}.{nearest(env_id, gym.registry)}")


def task_id(name: str) -> str:
    """
    The one name of a task.

    >>> task_id("PickCube-v1"), task_id("CPM/PickCube-v1"), task_id("CPMToy-v0")
    ('CPM/PickCube-v1', 'CPM/PickCube-v1', 'CPMToy-v0')

    :param name: a gymnasium id, or ManiSkill's own name of one of its tasks, which here has observations for player and
        challenger, and the namespace ``CPM/``
    :return: the gymnasium id; a task of ManiSkill is registered
    :raises ValueError: if there is no such task, with the nearest name
    """
    task = name.removeprefix(NAMESPACE)
    if f"{NAMESPACE}{task}" in gym.registry:
        return f"{NAMESPACE}{task}"
    register_suite(name)
    spec = gym.registry.get(name)
    if spec is not None and not getattr(getattr(spec.entry_point, "func", None), "__module__", "").startswith("mani_skill"):
        return name
    if importlib.util.find_spec("mani_skill") is not None and knows_task(task):
        register_task(task)
        return f"{NAMESPACE}{task}"
    raise ValueError(f"Unknown environment {name!r}.{nearest(name, [*gym.registry, *TASKS])}")


def ensure_registered(env_id: str) -> None:
    """
    Import what registers an environment, if it is one that a known package brings.

    :raises ValueError: if gymnasium does not know it, with the nearest name
    """
    register_suite(env_id)
    if env_id not in gym.registry:
        raise ValueError(f"Unknown environment {env_id!r}.{nearest(env_id, list(gym.registry))}")


def can_render(env_id: str) -> bool:
    """:return: whether an environment gives pictures"""
    spec = gym.spec(env_id)
    entry_point = spec.entry_point
    creator = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return creator is make_task or "rgb_array" in getattr(creator, "metadata", {}).get("render_modes", [])


def _robust(seed: int, makers: Sequence[Callable[[], gym.Env]], **kwargs: Any) -> VecEnv:
    """
    :param seed: of the run
    :param makers: of the environments
    :param kwargs: of the class
    :return: them in processes of their own
    """
    return RobustSubprocVecEnv([functools.partial(_in_a_worker, one, seed + rank) for rank, one in enumerate(makers)], **kwargs)


def _in_a_worker(make: Callable[[], gym.Env], seed: int) -> gym.Env:
    set_random_seed(seed)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main one ends this one
    return make()


# ---------------------------------------------------------------------- reading


def merge(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param base: is not changed
    :param overrides: dicts are merged entry by entry, everything else replaces; None removes
    :return: both
    """
    result = copy.deepcopy(dict(base))
    for key, value in overrides.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merge(result[key], value)
        elif value is None:
            result.pop(key, None)
        else:
            result[key] = copy.deepcopy(value)
    return result


def _quietly(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """rl_zoo3 prints what it reads; here that is in the run's config.yml."""
    with contextlib.redirect_stdout(io.StringIO()):
        return function(*args, **kwargs)
