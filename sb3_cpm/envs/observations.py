"""
From one ManiSkill render to the observation of the report (section 4.1): camera images for the challenger, a coloured
point cloud with additional points at the goal for the player, and what the robot knows of itself.

NumPy only: nothing here imports ManiSkill, so all of it is tested without a simulator. One render gives everything:
the colour of a point is the pixel's colour, its position is the pixel's position (millimetres in the camera's frame),
and what it belongs to is the pixel's segmentation id.
"""

from collections.abc import Mapping, Sequence

import numpy as np

GOAL_KEYS = ("goal_pos", "target_link_pos", "bin_pos")
"""Where the tasks of ManiSkill put the goal's position, in the order in which we look."""

STATE_KEYS = ("tcp_pose", *GOAL_KEYS, "target_angle_diff", "target_joint_axis", "is_grasped")
"""What of a task's extra observations a robot may know: itself and its goal. Never a pose of an object that it must find
with its cameras, even if a future version of ManiSkill shows one; therefore a list of what is kept, not of what is dropped."""

BACKGROUND_NAMES = ("ground", "table-workspace")
"""Scene objects that carry no information about the task and most of the pixels: 90% of PickCube's."""

GOAL_COLOR = (0.0, 1.0, 0.0)
"""ManiSkill's own colour for goal markers, which it hides from every observation; so no rendered point has it by chance."""

GOAL_RADIUS = 0.025
"""Metres; ManiSkill's success threshold of the Pick tasks and the radius of its goal marker."""

POINT_FEATURES = 6
"""x, y, z in metres, world frame; red, green, blue in [0, 1]."""


def world_points(position: np.ndarray, cam2world: np.ndarray) -> np.ndarray:
    """
    Turn a position texture into points of the world.

    :param position: millimetres in the camera's OpenGL frame, shape ``(height, width, 3)``, int16
    :param cam2world: the camera's pose as a homogeneous matrix, shape ``(4, 4)``
    :return: metres, shape ``(height * width, 3)``, float32
    """
    local = position.reshape(-1, 3).astype(np.float32) * np.float32(1e-3)
    return local @ cam2world[:3, :3].T.astype(np.float32) + cam2world[:3, 3].astype(np.float32)


def camera_points(
    rgb: np.ndarray,
    position: np.ndarray,
    segmentation: np.ndarray,
    cam2world: np.ndarray,
    background_ids: Sequence[int],
    max_distance: float,
) -> np.ndarray:
    """
    The coloured points that one camera sees, without background and without what is far away.

    Id 0 is where a ray hits nothing. The horizon must go by its id, not by its distance: beyond 32 m the int16 millimetres
    wrap around, and a point of the floor far away would appear next to the robot.

    :param rgb: shape ``(height, width, 3)``, uint8
    :param position: millimetres, shape ``(height, width, 3)``, int16
    :param segmentation: shape ``(height, width, 1)``, any integer type
    :param cam2world: shape ``(4, 4)``
    :param background_ids: segmentation ids to drop (0 is always dropped)
    :param max_distance: metres from the camera, farther points are dropped
    :return: shape ``(n, 6)`` with any n from 0 to height * width, float32
    """
    ids = segmentation.reshape(-1)
    keep = ids != 0
    for background_id in background_ids:
        keep &= ids != background_id
    index = np.flatnonzero(keep)  # few are left: what follows costs next to nothing
    position = position.reshape(-1, 3)[index]
    near = np.linalg.norm(position.astype(np.float32), axis=1) <= np.float32(1e3 * max_distance)
    colors = rgb.reshape(-1, 3)[index[near]].astype(np.float32) / np.float32(255)
    return np.concatenate([world_points(position[near], cam2world), colors], axis=1)


def resize_cloud(cloud: np.ndarray, n_points: int, rng: np.random.Generator, fallback: np.ndarray) -> np.ndarray:
    """
    A cloud of exactly ``n_points`` rows.

    Too many points: a random choice without replacement. Too few: the cloud is repeated, which a max pool over points
    does not notice. None at all: ``fallback`` (where the hand is) repeated, in black: a place that the robot knows
    anyway, within the range of values that the network is used to.

    :param cloud: shape ``(n, 6)``
    :param n_points: the number of rows wanted
    :param rng: drawn from only if there are too many points
    :param fallback: metres, shape ``(3,)``
    :return: shape ``(n_points, 6)``, float32
    """
    if len(cloud) > n_points:
        return cloud[rng.choice(len(cloud), n_points, replace=False)]
    if len(cloud) == 0:
        cloud = np.concatenate([fallback, np.zeros(3)])[None].astype(np.float32)
    return np.resize(cloud, (n_points, cloud.shape[1]))  # np.resize repeats from the start


def goal_cloud(goal: np.ndarray, n_points: int, radius: float = GOAL_RADIUS) -> np.ndarray:
    """
    The additional points near the goal (report, section 4.1): a Fibonacci lattice on a sphere, in :data:`GOAL_COLOR`.
    The same lattice at every step, so that these points move only when the goal does.

    :param goal: metres, shape ``(3,)``
    :param n_points: how many
    :param radius: metres
    :return: shape ``(n_points, 6)``, float32
    """
    index = np.arange(n_points) + 0.5
    height = 1 - 2 * index / max(n_points, 1)  # uniform in height is uniform on a sphere
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    lattice = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    cloud = np.empty((n_points, POINT_FEATURES), dtype=np.float32)
    cloud[:, :3] = goal + radius * lattice
    cloud[:, 3:] = GOAL_COLOR
    return cloud


def find_goal(extra: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """
    :param extra: the task's extra observations, unbatched
    :return: the goal's position in metres, shape ``(3,)``, or None where the task shows none
    """
    for key in GOAL_KEYS:
        if key in extra:
            return np.asarray(extra[key], dtype=np.float32).reshape(3)
    return None


def robot_state(agent: Mapping[str, np.ndarray], extra: Mapping[str, np.ndarray]) -> np.ndarray:
    """
    What the robot knows without cameras: joint positions and velocities, then :data:`STATE_KEYS` in that order, as far as
    the task has them. For PickCube: 9 + 9 + 7 (hand pose) + 3 (goal) + 1 (is grasped) numbers.

    :param agent: proprioception, unbatched ("qpos" and "qvel" first, then whatever controllers add, by name)
    :param extra: the task's extra observations, unbatched
    :return: shape ``(state_dim,)``, float32
    """
    own = [agent[key] for key in ("qpos", "qvel") if key in agent]
    own += [flat_vector(agent[key]) for key in sorted(agent) if key not in ("qpos", "qvel")]
    own += [extra[key] for key in STATE_KEYS if key in extra]
    return flat_vector(own)


def flat_vector(values: object) -> np.ndarray:
    """
    :param values: arrays, numbers or bools in nested dicts and sequences; dicts are read in their own order
    :return: all of it in one vector, float32
    """
    if isinstance(values, Mapping):
        values = list(values.values())
    if isinstance(values, (list, tuple)):
        parts = [flat_vector(value) for value in values]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.float32)
    return np.asarray(values, dtype=np.float32).reshape(-1)
