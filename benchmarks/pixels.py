"""Two tasks in small pictures. In Pendulum-v1 the rod's angle is drawn, how fast it turns has to be remembered."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SIZE = 32
ROD, WIDTH = 0.85, 0.16  # length and half width of the rod, the picture reaches from -1 to 1


class PendulumPixels(gym.ObservationWrapper):
    """
    Pendulum-v1 with a Dict observation ``camera`` of shape ``(32, 32, 1)``, uint8.

    :param kwargs: passed to ``gym.make``
    """

    def __init__(self, **kwargs: object) -> None:
        super().__init__(gym.make("Pendulum-v1", **kwargs))
        self.observation_space = spaces.Dict({"camera": spaces.Box(0, 255, (SIZE, SIZE, 1), np.uint8)})
        axis = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
        self._x, self._y = np.meshgrid(axis, -axis)

    def observation(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        cosine, sine = observation[:2]  # the angle is 0 where the rod points upwards
        along = -self._x * sine + self._y * cosine
        across = np.abs(self._x * cosine + self._y * sine)
        outside = np.maximum.reduce([across - WIDTH, along - ROD, -along - WIDTH])
        shade = np.clip(0.5 - outside * SIZE / 2, 0, 1)  # edges are one pixel wide
        return {"camera": (255 * shade).astype(np.uint8)[..., None]}


if "PendulumPixels-v0" not in gym.registry:
    gym.register("PendulumPixels-v0", entry_point="pixels:PendulumPixels")


class SquareToCentre(gym.Env):
    """
    A bright square on a dark picture is to be moved to the middle; it moves in the plane by the action.

    The picture, a Dict observation ``camera`` of shape ``(32, 32, 1)``, uint8, is all there is to see.
    Episodes begin anywhere.
    """

    STEP = 0.15  # of the greatest action; the middle is 0, the edges of the picture are -1 and 1
    HALF = 0.22  # half of the square's side

    def __init__(self) -> None:
        self.observation_space = spaces.Dict({"camera": spaces.Box(0, 255, (SIZE, SIZE, 1), np.uint8)})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        axis = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
        self._x, self._y = np.meshgrid(axis, -axis)
        self.position = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-0.8, 0.8, 2)
        return self._picture(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        self.position = np.clip(self.position + self.STEP * np.clip(action, -1, 1), -0.8, 0.8)
        return self._picture(), -float(np.linalg.norm(self.position)), False, False, {}

    def _picture(self) -> dict[str, np.ndarray]:
        outside = np.maximum(np.abs(self._x - self.position[0]), np.abs(self._y - self.position[1])) - self.HALF
        return {"camera": (255 * np.clip(0.5 - outside * SIZE / 2, 0, 1)).astype(np.uint8)[..., None]}


if "SquareToCentre-v0" not in gym.registry:
    gym.register("SquareToCentre-v0", entry_point="pixels:SquareToCentre", max_episode_steps=25)
