"""
Gymnasium ids of the tasks, so that rl_zoo3 finds them: ``CPM/PickCube-v1`` as the robot sees it (cameras, point cloud, what
it knows of itself), ``CPM/PickCubeState-v1`` as ManiSkill's full state vector. Only an id is registered; ManiSkill is imported
when an environment is made. Arguments of :func:`~sb3_cpm.envs.make_maniskill_env` go into ``env_kwargs`` of the YAML.
"""

import importlib.util
from typing import Any

import gymnasium as gym

import sb3_cpm.envs.reach  # registers CPMReach-v0
import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.arguments import nearest
from sb3_cpm.envs.maniskill.tasks import knows_task
from sb3_cpm.envs.suites import register_suite

TASKS = (
    "PickCube-v1",
    "StackCube-v1",
    "PickSingleYCB-v1",
    "TurnFaucet-v1",
    "OpenCabinetDoor-v1",
    "PickSingleEGAD-v1",
    "LiftCube-v1",
)
"""The seven tasks that the configurations name."""

NAMESPACE = "CPM/"


def env_id_of(task: str, state: bool = False) -> str:
    """
    >>> env_id_of("PickCube-v1"), env_id_of("PickCube-v1", state=True)
    ('CPM/PickCube-v1', 'CPM/PickCubeState-v1')

    :param task: ManiSkill's name of it
    :param state: the variant whose observation is the full state vector
    :return: gymnasium's id
    """
    name, _, version = task.rpartition("-v")
    return f"{NAMESPACE}{name}{'State' if state else ''}-v{version}"


ENV_IDS = tuple(env_id_of(task, state) for state in (False, True) for task in TASKS)
"""All ids that :func:`register_tasks` registers."""


def register_tasks() -> None:
    """Make the ids known to gymnasium. Can be repeated."""
    for state in (False, True):
        for task in TASKS:
            register_task(task, state)


def register_task(task: str, state: bool = False) -> None:
    """
    Make one id known to gymnasium. Can be repeated.

    :param task: ManiSkill's name of it
    :param state: the variant whose observation is the full state vector
    """
    if env_id_of(task, state) not in gym.registry:
        gym.register(
            id=env_id_of(task, state),
            entry_point="sb3_cpm.agents.tasks:make_task",
            kwargs={"task": task, **({"obs_mode": "state"} if state else {})},
            # both wrap what is already checked and ordered, and would hide `batch` from wrappers
            disable_env_checker=True,
            order_enforce=False,
        )


def make_task(task: str, render_mode: str | None = None, **kwargs: Any) -> gym.Env:
    """
    What gymnasium calls to make an environment.

    :param task: ManiSkill's name of it
    :param render_mode: ``"rgb_array"``, None, or ``"human"``, which ``enjoy`` wants: SB3 then shows the ``"rgb_array"``
    :param kwargs: of :func:`~sb3_cpm.envs.make_maniskill_env`
    """
    from sb3_cpm.envs import make_maniskill_env

    return make_maniskill_env(task, render_mode="rgb_array" if render_mode == "human" else render_mode, **kwargs)


def ensure_registered(env_id: str) -> None:
    """
    Register our tasks, and import what registers an environment, if it is one that a known package brings.

    :raises ValueError: if gymnasium does not know it, with the nearest name
    """
    register_tasks()
    register_suite(env_id)
    if env_id not in gym.registry:
        raise ValueError(f"Unknown environment {env_id!r}.{nearest(env_id, list(gym.registry))}")


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
        told = f"cannot import {module!r}, which should register {env_id!r} ({error})"
        raise ValueError(f"env={module}:{env_id}: {told}") from error
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
    register_tasks()
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


def can_render(env_id: str) -> bool:
    """:return: whether an environment gives pictures"""
    spec = gym.spec(env_id)
    entry_point = spec.entry_point
    creator = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return creator is make_task or "rgb_array" in getattr(creator, "metadata", {}).get("render_modes", [])
