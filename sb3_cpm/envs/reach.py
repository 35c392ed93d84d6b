"""A point that has to get to a goal and stay there, with motors of several kinds: objects of unequal difficulty."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

#: Metres that an action of 1 moves the point, by instance.
GAINS = {"strong": 0.12, "medium": 0.08, "weak": 0.05}
SUCCESS_DISTANCE = 0.15


class ReachEnv(gym.Env):
    """
    Point on the table [-1, 1] x [-1, 1] with a goal, registered as ``CPMReach-v0`` with episodes of 30 steps, which never end
    before. Each episode has one of several instances, which differ in how far an action moves the point; only the last
    displacement tells them apart, and ``info["instance"]`` names them. The reward is 1 at the goal and 0 elsewhere.

    Observation: a Dict with ``"state"``, positions of point and goal and the last displacement, shape ``(6,)``, float32.

    :param instances: names of those that occur, each equally often
    :raises ValueError: for an instance that there is not
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, instances: Sequence[str] = tuple(GAINS)) -> None:
        unknown = [name for name in instances if name not in GAINS]
        if unknown or not instances:
            raise ValueError(f"instances={tuple(instances)}: expected some of {tuple(GAINS)}")
        self.instances = tuple(instances)
        self.observation_space = spaces.Dict({"state": spaces.Box(-2.0, 2.0, (6,), np.float32)})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.instance = self.instances[0]
        self._point, self._goal, self._moved = np.zeros(2), np.zeros(2), np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.instance = self.instances[int(self.np_random.integers(len(self.instances)))]
        self._point, self._goal = self.np_random.uniform(-0.8, 0.8, (2, 2))
        self._moved = np.zeros(2)
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        before = self._point
        self._point = np.clip(before + GAINS[self.instance] * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        self._moved = self._point - before
        info = self._info()
        return self._observe(), float(info["is_success"]), False, False, info

    def expert_action(self) -> np.ndarray:
        """:return: straight to the goal, and stay"""
        return np.clip((self._goal - self._point) / GAINS[self.instance], -1.0, 1.0).astype(np.float32)

    def _observe(self) -> dict[str, np.ndarray]:
        return {"state": np.concatenate([self._point, self._goal, self._moved]).astype(np.float32)}

    def _info(self) -> dict[str, Any]:
        success = bool(np.hypot(*(self._goal - self._point)) < SUCCESS_DISTANCE)
        return {"is_success": success, "instance": self.instance}


if "CPMReach-v0" not in gym.registry:
    gym.register(id="CPMReach-v0", entry_point="sb3_cpm.envs.reach:ReachEnv", max_episode_steps=30)
