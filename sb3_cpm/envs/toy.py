"""
A small fast environment with everything that a robot task has: camera image, point cloud, state, dense reward, success.

A point robot on a table moves to a goal (``task="reach"``), or pushes a puck there (``task="push"``). It exists for tests
and for first looks at the method; it needs nothing but NumPy and makes several thousand steps per second with all keys.
"""

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces

KEYS = ("camera", "pointcloud", "state")
IMAGE_SIZE = 32
STEP_LENGTH = 0.1
BODY_RADIUS = 0.12
SUCCESS_DISTANCE = 0.15
BACKGROUND = np.array([235, 235, 230], dtype=np.uint8)
ROBOT_COLOUR = np.array([40, 90, 200], dtype=np.uint8)
PUCK_COLOUR = np.array([230, 120, 30], dtype=np.uint8)
GOAL_COLOUR = np.array([60, 170, 80], dtype=np.uint8)


class ToyEnv(gym.Env):
    """
    Point robot on the table [-1, 1] x [-1, 1], registered as ``CPMToy-v0`` with episodes of 50 steps.

    The action is the next displacement, in units of ``STEP_LENGTH``. Observations (a Dict with the keys asked for):

    * ``"camera"``: the table from above, shape ``(32, 32, 3)``, uint8
    * ``"pointcloud"``: points on robot, puck and goal: xyz and rgb in [0, 1], shape ``(n_points, 6)``, float32
    * ``"state"``: positions of robot, goal and (when pushing) puck, shape ``(4,)`` or ``(6,)``, float32

    :param keys: the observation keys wanted, a subset of ``("camera", "pointcloud", "state")``
    :param task: ``"reach"`` or ``"push"``
    :param n_points: rows of the point cloud
    :param point_labels: points have a last column with the body that they belong to: 0 robot, 1 goal, 2 puck
    :param terminate_on_success: end the episode with success (otherwise it goes on to the time limit)
    :param render_mode: ``"rgb_array"`` for videos, or None
    :raises ValueError: for an unknown key or task
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        keys: Sequence[str] = KEYS,
        task: Literal["reach", "push"] = "reach",
        n_points: int = 48,
        point_labels: bool = False,
        terminate_on_success: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if not keys or not set(keys) <= set(KEYS):
            raise ValueError(f"keys={tuple(keys)}: expected at least one of {KEYS}")
        if task not in ("reach", "push"):
            raise ValueError(f"task={task!r}: expected 'reach' or 'push'")
        self.keys = tuple(keys)
        self.task = task
        self.point_labels = point_labels
        self.terminate_on_success = terminate_on_success
        self.render_mode = render_mode

        n_bodies = 3 if task == "push" else 2
        available: dict[str, spaces.Space] = {
            "camera": spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8),
            "pointcloud": spaces.Box(-2.0, 2.0, (n_points, 6 + point_labels), np.float32),
            "state": spaces.Box(-1.0, 1.0, (2 * n_bodies,), np.float32),
        }
        self.observation_space = spaces.Dict({key: available[key] for key in self.keys})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

        # rows: robot, goal, puck (only when pushing)
        self._positions = np.zeros((n_bodies, 2))
        self._colours = np.stack([ROBOT_COLOUR, GOAL_COLOUR, PUCK_COLOUR][:n_bodies])
        # the shape of each body as points is drawn once: body of point i, and where on it
        self._body_of_point = np.arange(n_points) % n_bodies
        self._point_offsets = np.random.default_rng(0).uniform(-BODY_RADIUS, BODY_RADIUS, (n_points, 2))
        self._pixels = _pixel_centres(IMAGE_SIZE)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self._positions[:] = self.np_random.uniform(-0.8, 0.8, self._positions.shape)
        return self._observe(), {"is_success": self._success()}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        robot = self._positions[0]
        robot += STEP_LENGTH * np.clip(action, -1.0, 1.0)
        if self.task == "push":
            self._push()
        np.clip(self._positions, -1.0, 1.0, out=self._positions)
        success = self._success()
        return self._observe(), self._reward(success), success and self.terminate_on_success, False, {"is_success": success}

    def expert_action(self) -> np.ndarray:
        """:return: what a scripted expert does now; it pushes from the side of the puck that is away from the goal"""
        robot, goal = self._positions[:2]
        target = goal
        if self.task == "push":
            puck = self._positions[2]
            ahead = (goal - puck) / max(self._distance(1, 2), 1e-9)
            target = robot if self._success() else puck - 2 * BODY_RADIUS * ahead  # where the robot touches it
            offset = robot - puck
            if not self._success() and offset @ ahead > -0.9 * np.hypot(*offset):  # not behind it: around it, at a distance
                aside = np.array([-ahead[1], ahead[0]])
                side = 1.0 if offset @ aside >= 0 else -1.0
                beside = puck + 3 * BODY_RADIUS * (side * aside if offset @ ahead > 0 else -ahead)
                target = beside
            elif not self._success():
                target = target + np.clip(goal - puck, -STEP_LENGTH, STEP_LENGTH)
        return np.clip((target - robot) / STEP_LENGTH, -1.0, 1.0).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """:return: the table from above, shape ``(256, 256, 3)``, uint8"""
        if self.render_mode != "rgb_array":
            return None
        return self._draw(_pixel_centres(256))

    def _push(self) -> None:
        """The puck gives way along the line between the centres until the two bodies only touch."""
        robot, puck = self._positions[0], self._positions[2]
        offset = puck - robot
        distance = float(np.hypot(*offset))
        if 0 < distance < 2 * BODY_RADIUS:
            puck += offset * (2 * BODY_RADIUS / distance - 1)

    def _distance(self, one: int, other: int) -> float:
        return float(np.hypot(*(self._positions[one] - self._positions[other])))

    def _success(self) -> bool:
        """Is the body that matters at the goal?"""
        return self._distance(-1 if self.task == "push" else 0, 1) < SUCCESS_DISTANCE

    def _reward(self, success: bool) -> float:
        """Dense and normalized to [0, 1]: nearness to the goal; when pushing, a third of it for nearness to the puck."""
        if success:
            return 1.0
        if self.task == "reach":
            return 1 - float(np.tanh(self._distance(0, 1)))
        return 1 - (float(np.tanh(self._distance(0, 2))) + 2 * float(np.tanh(self._distance(2, 1)))) / 3

    def _observe(self) -> dict[str, np.ndarray]:
        observation: dict[str, np.ndarray] = {}
        if "camera" in self.keys:
            observation["camera"] = self._draw(self._pixels)
        if "pointcloud" in self.keys:
            observation["pointcloud"] = self._points()
        if "state" in self.keys:
            observation["state"] = self._positions.astype(np.float32).ravel()
        return observation

    def _points(self) -> np.ndarray:
        cloud = np.zeros((len(self._point_offsets), 6 + self.point_labels), dtype=np.float32)
        cloud[:, :2] = self._positions[self._body_of_point] + self._point_offsets
        cloud[:, 3:6] = self._colours[self._body_of_point] / np.float32(255)
        if self.point_labels:
            cloud[:, 6] = self._body_of_point
        return cloud

    def _draw(self, pixels: np.ndarray) -> np.ndarray:
        """Discs on a plain table; the goal is drawn first, so that what stands on it is seen."""
        image = np.empty((*pixels.shape[:2], 3), dtype=np.uint8)
        image[:] = BACKGROUND
        for body in (1, *range(2, len(self._positions)), 0):
            offset = pixels - self._positions[body]
            image[(offset * offset).sum(-1) < BODY_RADIUS**2] = self._colours[body]
        return image


def _pixel_centres(size: int) -> np.ndarray:
    """:return: table coordinates of every pixel, x to the right and y upwards, shape ``(size, size, 2)``"""
    axis = (np.arange(size) + 0.5) / size * 2.2 - 1.1
    x, y = np.meshgrid(axis, -axis)
    return np.stack([x, y], axis=-1)


if "CPMToy-v0" not in gym.registry:
    gym.register(id="CPMToy-v0", entry_point="sb3_cpm.envs.toy:ToyEnv", max_episode_steps=50)
