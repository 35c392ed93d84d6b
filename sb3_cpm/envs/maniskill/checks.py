"""What can be wrong with a request for a ManiSkill task, found out before anything is built, and said with the cure."""

import contextlib
import difflib
import inspect
import logging
import os
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

from sb3_cpm.arguments import argument_names, nearest
from sb3_cpm.envs.maniskill.assets import missing_assets, require_assets
from sb3_cpm.envs.maniskill.tasks import register_report_tasks, registered_name
from sb3_cpm.machine.rendering import Renderer, ensure_renderer, without_renderer

DEFAULT_ROBOT = "panda_wristcam"
"""The Panda with a camera at its hand, the report's robot."""

NEEDS_PICTURES = ("OpenCabinetDrawer-v1", "OpenCabinetDoor-v1")
"""Tasks that read where something is from the shapes that are drawn, here the handles: they need a renderer in any mode."""


class CheckedTask(NamedTuple):
    """
    A task that can be built.

    :param env_id: name under which ManiSkill has it with the reward that is wanted
    :param robot: ManiSkill's name of the robot, None if the task chooses one that we cannot know
    :param robot_kwargs: what to tell the task about its robot
    :param max_episode_steps: steps until truncation
    """

    env_id: str
    robot: str | None
    robot_kwargs: dict[str, Any]
    max_episode_steps: int


def check_sizes(
    image_size: int | tuple[int, int],
    n_points: int,
    goal_points: int,
    max_distance: float,
    max_episode_steps: int | None,
    render_size: int,
) -> tuple[int, int]:
    """
    :return: height and width of the images
    :raises ValueError: if a number is of no use
    """
    size = tuple(image_size) if isinstance(image_size, (tuple, list)) else (image_size, image_size)
    if len(size) != 2 or not all(isinstance(side, int) and side > 0 for side in size):
        raise ValueError(f"image_size must be a positive number of pixels or (height, width), got {image_size!r}.")
    if max_episode_steps is not None and max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be at least 1 or None for the task's own, got {max_episode_steps!r}.")
    if not max_distance > 0:
        raise ValueError(f"max_distance must be a positive number of metres, got {max_distance!r}.")
    if not (isinstance(render_size, int) and render_size > 0):
        raise ValueError(f"render_size must be a positive number of pixels, got {render_size!r}.")
    for name, value in (("n_points", n_points), ("goal_points", goal_points)):
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}.")
    return size[0], size[1]


#: Arguments of ManiSkill's tasks that are set here, and by which of ours.
SET_HERE = {
    "sensor_configs": "image_size",
    "human_render_camera_configs": "render_size",
    "render_backend": "the machine's devices",
    "sim_backend": "make_maniskill_vec_env",
    "num_envs": "make_maniskill_vec_env",
}


def check_task_kwargs(env_id: str, task_kwargs: Mapping[str, Any], ours: Collection[str]) -> None:
    """
    :param env_id: name of the task
    :param task_kwargs: arguments that it is to be given on top of ours
    :param ours: names of those that we take
    :raises ValueError: for names that neither the task nor we take, with the nearest, and for what is set otherwise
    """
    from mani_skill.utils.registration import REGISTERED_ENVS

    theirs = argument_names(REGISTERED_ENVS[env_id].cls)
    for name in task_kwargs:
        if name in SET_HERE:
            raise ValueError(f"{name} is set by {SET_HERE[name]}, leave it out.")
        if theirs is not None and name not in theirs:
            raise ValueError(
                f"{env_id} takes no argument {name!r}.{nearest(name, {*ours, *theirs} - SET_HERE.keys())} Valid: "
                f"{', '.join(sorted(ours))}, and of the task {', '.join(sorted(theirs - {*ours, *SET_HERE}))}."
            )


def choose_renderer(env_id: str, obs_mode: str) -> Renderer:
    """
    :param env_id: name of the task
    :param obs_mode: ``"state"`` needs no pictures, so it works without a Vulkan driver
    :return: the renderer of this process, with the backend ``"none"`` if there is none and none is needed
    :raises RuntimeError: if a renderer is needed and this machine has none, with the cure
    """
    try:
        return ensure_renderer()
    except RuntimeError as error:
        if obs_mode != "state":
            raise
        if env_id in NEEDS_PICTURES:
            raise RuntimeError(
                f"{env_id} needs a renderer even with obs_mode='state': it finds the handles by their looks. {error}"
            ) from error
        return without_renderer()


def check_task(
    env_id: str, robot: str | None, control_mode: str, reward_mode: str, max_episode_steps: int | None
) -> CheckedTask:
    """
    :param env_id: name of the task
    :param robot: name of the robot or None for :data:`DEFAULT_ROBOT` where possible
    :param control_mode: name of the controller
    :param reward_mode: kind of reward
    :param max_episode_steps: None for the task's own
    :raises ValueError: if the task, robot, controller or reward does not exist, naming those that do
    :raises RuntimeError: if files that the task needs are missing, with the command that downloads them
    """
    from mani_skill.agents.registration import REGISTERED_AGENTS
    from mani_skill.utils.registration import REGISTERED_ENVS

    register_report_tasks()
    if env_id not in REGISTERED_ENVS:
        raise ValueError(f"Unknown task {env_id!r}. {_nearest(env_id, REGISTERED_ENVS)}")
    spec = REGISTERED_ENVS[registered_name(env_id, reward_mode)]
    if robot is not None and robot not in REGISTERED_AGENTS:
        raise ValueError(f"Unknown robot {robot!r}. {_nearest(robot, REGISTERED_AGENTS)}")
    modes = REGISTERED_ENVS[registered_name(env_id, "dense")].cls.SUPPORTED_REWARD_MODES
    if reward_mode not in modes:
        raise ValueError(f"{env_id} has no reward_mode {reward_mode!r}, it has: {', '.join(modes)}.")
    steps = max_episode_steps or spec.max_episode_steps
    if steps is None:
        raise ValueError(f"{env_id} has no time limit of its own: pass max_episode_steps=...")
    robot = _choose_robot(env_id, spec.cls.SUPPORTED_ROBOTS, robot)
    task = CheckedTask(spec.uid, robot or _own_robot(spec.cls), {} if robot is None else {"robot_uids": robot}, steps)
    if task.robot in REGISTERED_AGENTS:
        _check_robot(REGISTERED_AGENTS[task.robot].agent_cls, control_mode)
    require_assets(env_id)
    return task


@contextlib.contextmanager
def explained(env_id: str) -> Iterator[None]:
    """
    Around the building of a task: whatever ManiSkill says about missing files becomes an error with the cure, and its warning
    that the robot with the hand camera is not in the task's list (it is the listed Panda with a camera) stays away.
    """
    from mani_skill import logger

    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    except (FileNotFoundError, EOFError, SystemExit) as error:
        raise missing_assets(env_id, str(error)) from error
    except RuntimeError as error:
        # "Failed to load ..." is SAPIEN's word for a damaged file
        if "download" not in str(error).lower() and "failed to load" not in str(error).lower():
            raise
        raise missing_assets(env_id, str(error)) from error
    except AttributeError as error:
        # ManiSkill's tasks measure the collision shapes, without which SAPIEN goes on where it cannot read them
        if "bounding_box" not in str(error):
            raise
        raise missing_assets(env_id, "an object has no collision shapes, SAPIEN could not read its file") from error
    finally:
        logger.setLevel(level)


def _choose_robot(env_id: str, supported: Any, robot: str | None) -> str | None:
    """:return: the robot to ask for, None for the task's own choice (several robots at once, for instance)"""
    alone = {name for name in supported or () if isinstance(name, str)}
    if alone & {"panda", DEFAULT_ROBOT}:
        alone.add(DEFAULT_ROBOT)  # the same arm, with a camera
    if robot is None:
        return DEFAULT_ROBOT if DEFAULT_ROBOT in alone else None
    if supported is not None and robot not in alone:
        raise ValueError(f"{env_id} is not made for robot {robot!r}. It takes: {', '.join(sorted(alone)) or supported}.")
    return robot


def _check_robot(agent_class: Any, control_mode: str) -> None:
    from mani_skill import format_path

    path = agent_class.urdf_path or agent_class.mjcf_path
    if isinstance(path, str) and not os.path.exists(format_path(path)):
        raise RuntimeError(
            f"The files of robot {agent_class.uid!r} are missing: {format_path(path)}. Download them with:\n"
            f"    python -m mani_skill.utils.download_asset {agent_class.uid}"
        )
    # the names of the controllers need no simulated robot, only names of joints and links, which some robots set when they are
    # made; where a robot needs more, ManiSkill will complain itself
    unmade = type("Unmade", (agent_class,), {"__getattr__": lambda robot, name: None})
    try:
        controllers = list(agent_class._controller_configs.fget(object.__new__(unmade)))
    except Exception:
        return
    if control_mode not in controllers:
        raise ValueError(
            f"Robot {agent_class.uid!r} has no controller {control_mode!r}. {_nearest(control_mode, controllers)} "
            f"All: {', '.join(controllers)}."
        )


def _own_robot(task_class: Any) -> str | None:
    parameter = inspect.signature(task_class.__init__).parameters.get("robot_uids")
    return parameter.default if parameter is not None and isinstance(parameter.default, str) else None


def _nearest(name: str, names: Any) -> str:
    near = difflib.get_close_matches(name, list(names), n=3, cutoff=0.4)
    return f"Did you mean {' or '.join(near)}?" if near else f"There are: {', '.join(sorted(names))}."
