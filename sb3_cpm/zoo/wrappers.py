"""Wrappers that configuration files name."""

from typing import Any, SupportsFloat

import gymnasium as gym


class TerminationIsSuccess(gym.Wrapper[Any, Any, Any, Any]):
    """
    Say ``is_success`` where an environment only says so by ending the episode, such as MountainCarContinuous-v0.

    :param env: the environment; its ``terminated`` must mean success
    """

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": bool(terminated)}
