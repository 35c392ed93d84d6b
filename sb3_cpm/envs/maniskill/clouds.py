"""
Point clouds from rendered pictures (report, section 4.1), for a batch of environments at once.

NumPy only: nothing here imports ManiSkill, so all of it is tested without a simulator. One render gives everything: the
colour of a point is the pixel's colour, its position is the pixel's position (millimetres in the camera's frame), and what
it belongs to is the pixel's segmentation id. N is the number of environments throughout.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

SAMPLINGS = ("random", "farthest")
FRAMES = ("world", "base", "end_effector")

BACKGROUND_NAMES = ("ground", "table-workspace")
"""Scene objects that carry no information about the task and most of the pixels: 90% of PickCube's."""

BACKGROUND, ROBOT, GOAL = -1, 0, -1
"""Labels: background points are dropped, the robot is 0, objects count from 1; so -1 is free for the points at the goal."""

TARGET, REST, OTHER = 1, 2, 3
"""Labels by role: the thing to act on, the rest of what it is a part of, everything else."""

LABELS = (False, True, "roles")

GOAL_COLOR = (0.0, 1.0, 0.0)
"""ManiSkill's own colour for goal markers, which it hides from every observation; so no rendered point has it by chance."""

GOAL_RADIUS = 0.025
"""Metres; ManiSkill's success threshold of the Pick tasks and the radius of its goal marker."""

POINT_FEATURES = 6
"""x, y, z in metres; red, green, blue in [0, 1]; a seventh is the label, where wanted."""


class CloudSettings(NamedTuple):
    """
    What a cloud is to be, see :func:`sb3_cpm.envs.make_maniskill_env`.

    :param n_points: points of the scene; 0 for no cloud
    :param goal_points: additional points around the goal
    :param max_distance: metres from the camera beyond which points are dropped
    :param sampling: one of :data:`SAMPLINGS`
    :param frame: one of :data:`FRAMES`
    :param labels: whether the last column says what a point belongs to; ``"roles"``: by what that is for
    """

    n_points: int = 256
    goal_points: int = 50
    max_distance: float = 3.0
    sampling: str = "random"
    frame: str = "world"
    labels: bool | str = False

    def check(self) -> "CloudSettings":
        """
        :return: these settings
        :raises ValueError: if a name is unknown
        """
        for name, value, known in (
            ("point_sampling", self.sampling, SAMPLINGS),
            ("point_frame", self.frame, FRAMES),
            ("point_labels", self.labels, LABELS),
        ):
            if value not in known:
                raise ValueError(f"{name} must be one of {', '.join(map(str, known))}, got {value!r}.")
        return self


class Picture(NamedTuple):
    """
    What one camera of each environment saw.

    :param rgb: shape ``(N, height, width, 3)``, uint8
    :param position: millimetres in the camera's OpenGL frame, shape ``(N, height, width, 3)``, int16
    :param segmentation: shape ``(N, height, width, 1)``, any integer type
    :param cam2world: the camera's pose as a homogeneous matrix, shape ``(N, 4, 4)``
    """

    rgb: np.ndarray
    position: np.ndarray
    segmentation: np.ndarray
    cam2world: np.ndarray


def scene_points(pictures: Sequence[Picture], labels: np.ndarray, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
    """
    The coloured points that all cameras see, without background and without what is far away.

    The horizon must go by its label, not by its distance: beyond 32 m the int16 millimetres wrap around, and a point of the
    floor far away would appear next to the robot.

    :param pictures: one per camera
    :param labels: what a segmentation id stands for, per environment, shape ``(N, n_ids)``; :data:`BACKGROUND` is dropped.
        Larger ids are taken for the last one
    :param max_distance: metres from the camera
    :return: x, y, z (metres, world frame), red, green, blue, label, shape ``(n, 7)``, float32; and the environment of each
        point, ascending, shape ``(n,)``
    """
    parts, owners = [], []
    for picture in pictures:
        points, owner = _camera_points(picture, labels, max_distance)
        parts.append(points)
        owners.append(owner)
    points, owner = np.concatenate(parts), np.concatenate(owners)
    if len(labels) > 1:
        order = np.argsort(owner, kind="stable")
        points, owner = points[order], owner[order]
    return points, owner


def _camera_points(picture: Picture, labels: np.ndarray, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
    n_envs, n_ids = labels.shape
    ids = np.minimum(picture.segmentation.reshape(n_envs, -1), n_ids - 1)
    found = labels.take(ids + n_ids * np.arange(n_envs)[:, None]).reshape(-1)
    pixel = np.flatnonzero(found != BACKGROUND)  # few are left: what follows costs next to nothing
    local = picture.position.reshape(-1, 3).take(pixel, axis=0) * np.float32(1e-3)
    near = np.flatnonzero(np.einsum("ni,ni->n", local, local) <= max_distance**2)
    if len(near) < len(pixel):
        pixel, local = pixel[near], local[near]
    owner = pixel // ids.shape[1]

    points = np.empty((len(owner), POINT_FEATURES + 1), dtype=np.float32)
    rotation, translation = picture.cam2world[:, :3, :3], picture.cam2world[:, :3, 3]
    points[:, :3] = np.einsum("nij,nj->ni", rotation[owner], local) + translation[owner]
    np.divide(picture.rgb.reshape(-1, 3).take(pixel, axis=0), np.float32(255), out=points[:, 3:6])
    points[:, 6] = found.take(pixel)
    return points, owner


def resize_clouds(
    points: np.ndarray,
    owner: np.ndarray,
    n_points: int,
    sampling: str,
    fallback: np.ndarray,
    rng: Callable[[int], np.random.Generator],
) -> np.ndarray:
    """
    Clouds of exactly ``n_points`` rows.

    Too many points: a choice without replacement. Too few: the cloud is repeated, which a max pool over points does not
    notice. None at all: ``fallback`` (where the hand is) repeated, in black: a place that the robot knows anyway, within
    the range of values that the network is used to.

    :param points: of all environments, shape ``(n, features)``
    :param owner: environment of each point, ascending, shape ``(n,)``
    :param n_points: the number of rows wanted
    :param sampling: how to choose, one of :data:`SAMPLINGS`
    :param fallback: metres, shape ``(N, 3)``
    :param rng: random numbers for environment i, asked for only if it has too many points
    :return: shape ``(N, n_points, features)``, float32
    """
    clouds = np.empty((len(fallback), n_points, points.shape[1]), dtype=np.float32)
    ends = np.searchsorted(owner, np.arange(len(fallback) + 1))
    for i, (start, end) in enumerate(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)):
        cloud = points[start:end]
        if len(cloud) > n_points and sampling == "farthest":
            clouds[i] = cloud[farthest_points(cloud[:, :3], n_points)]
        elif len(cloud) > n_points:
            clouds[i] = cloud[rng(i).choice(len(cloud), n_points, replace=False)]
        elif len(cloud):
            clouds[i] = np.resize(cloud, clouds.shape[1:])  # np.resize repeats from the start
        else:
            clouds[i] = 0
            clouds[i, :, :3] = fallback[i]
    return clouds


def farthest_points(points: np.ndarray, n_points: int) -> np.ndarray:
    """
    Farthest-point sampling: each next point is the one farthest from all chosen so far. Starts at the point that is farthest
    from the middle, so there is nothing random in it. Costs ``n_points`` passes over the points; NumPy's own are as fast as
    anything that could be installed for it everywhere.

    :param points: metres, shape ``(n, 3)``
    :param n_points: at most n
    :return: indices, shape ``(n_points,)``
    """
    centered = points - points.mean(axis=0)
    squares = np.einsum("ni,ni->n", centered, centered)
    doubled = 2 * centered
    chosen = np.empty(n_points, dtype=np.intp)
    nearest = np.full(len(points), np.inf, dtype=centered.dtype)  # squared distance to the chosen ones
    index = int(squares.argmax())
    for i in range(n_points):
        chosen[i] = index
        np.minimum(nearest, squares - doubled @ centered[index] + squares[index], out=nearest)
        nearest[index] = -1  # never again, even among points that coincide
        index = int(nearest.argmax())
    return chosen


def goal_clouds(goal: np.ndarray, n_points: int, radius: float = GOAL_RADIUS) -> np.ndarray:
    """
    The additional points near the goal (report, section 4.1): a Fibonacci lattice on a sphere, in :data:`GOAL_COLOR`.
    The same lattice at every step, so that these points move only when the goal does.

    :param goal: metres, shape ``(N, 3)``
    :param n_points: how many
    :param radius: metres
    :return: shape ``(N, n_points, 7)``, float32, label :data:`GOAL`
    """
    clouds = np.empty((len(goal), n_points, POINT_FEATURES + 1), dtype=np.float32)
    clouds[:, :, :3] = goal[:, None] + radius * _lattice(n_points)
    clouds[:, :, 3:6] = GOAL_COLOR
    clouds[:, :, 6] = GOAL
    return clouds


@functools.cache
def _lattice(n_points: int) -> np.ndarray:
    """Points on the unit sphere, shape ``(n_points, 3)``."""
    index = np.arange(n_points) + 0.5
    height = 1 - 2 * index / max(n_points, 1)  # uniform in height is uniform on a sphere
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def to_frame(clouds: np.ndarray, pose: np.ndarray) -> None:
    """
    Turn points of the world into points as seen from a frame, in place.

    :param clouds: x, y, z first, shape ``(N, n, features)``
    :param pose: the frame in the world: position, then quaternion (w, x, y, z), shape ``(N, 7)``
    """
    # row vectors: local = (world - position) @ R is R^T (world - position)
    clouds[:, :, :3] = (clouds[:, :, :3] - pose[:, None, :3]) @ rotation_matrices(pose[:, 3:7])


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """
    :param quaternions: unit quaternions (w, x, y, z), shape ``(N, 4)``
    :return: shape ``(N, 3, 3)``
    """
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class Thing(NamedTuple):
    """
    Something that a camera sees.

    :param name: ManiSkill's
    :param is_robot: whether it is part of a robot
    :param role: of what is not: :data:`TARGET`, :data:`REST` or :data:`OTHER`
    """

    name: str
    is_robot: bool
    role: int = OTHER


def label_table(scenes: Sequence[dict[int, Thing]], by_role: bool = False) -> np.ndarray:
    """
    What segmentation ids stand for: the robot is 0, the other things count from 1 in the order in which the scene lists them.

    :param scenes: for each environment: id to the thing
    :param by_role: other things are labelled by their roles instead
    :return: shape ``(N, n_ids)``; id 0, where a ray hits nothing, is background. The last column is for unknown ids: things
    """
    n_ids = 2 + max((i for things in scenes for i in things), default=0)
    table = np.full((len(scenes), n_ids), OTHER if by_role else 1, dtype=np.int16)
    table[:, 0] = BACKGROUND
    for row, things in zip(table, scenes, strict=True):
        label = ROBOT
        for i, thing in things.items():
            if thing.name in BACKGROUND_NAMES:
                row[i] = BACKGROUND
            elif thing.is_robot:
                row[i] = ROBOT
            elif by_role:
                row[i] = thing.role
            else:
                label += 1
                row[i] = label
    return table


def make_clouds(
    settings: CloudSettings,
    pictures: Sequence[Picture],
    labels: np.ndarray,
    goal: np.ndarray | None,
    hand: np.ndarray,
    frame: np.ndarray | None,
    rng: Callable[[int], np.random.Generator],
) -> np.ndarray:
    """
    From pictures to clouds.

    :param settings: what is wanted
    :param pictures: one per camera
    :param labels: see :func:`scene_points`
    :param goal: metres, shape ``(N, 3)``, None where the task shows none
    :param hand: metres, for environments whose cameras see nothing, shape ``(N, 3)``
    :param frame: pose of the frame of reference, shape ``(N, 7)``, None for the world
    :param rng: see :func:`resize_clouds`
    :return: shape ``(N, n_points + goal_points, 6 or 7)``, float32
    """
    points, owner = scene_points(pictures, labels, settings.max_distance)
    features = POINT_FEATURES + int(bool(settings.labels))
    clouds: Any = resize_clouds(points[:, :features], owner, settings.n_points, settings.sampling, hand, rng)
    if goal is not None and settings.goal_points:
        clouds = np.concatenate([clouds, goal_clouds(goal, settings.goal_points)[:, :, :features]], axis=1)
    if frame is not None:
        to_frame(clouds, frame)
    return clouds
