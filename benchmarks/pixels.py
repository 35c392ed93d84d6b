"""Pendulum-v1 seen as a small picture: the rod's angle is drawn, how fast it turns has to be remembered."""

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
