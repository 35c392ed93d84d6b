"""A Box observation is a Dict with one key: world model and buffer know Dicts only, users have both."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

#: Key under which world model and buffer know the observation of an environment with a Box space; the one that
#: ``sb3_cpm.envs.DictObservation`` gives, so that models and buffers of the wrapped environment fit the bare one.
OBSERVATION = "state"


def as_dict_space(space: spaces.Space) -> spaces.Dict:
    """
    :param space: of an environment
    :return: the same as a Dict
    :raises ValueError: unless it is a Box or a Dict
    """
    if isinstance(space, spaces.Dict):
        return space
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"Dreamer reads images and vectors (a Box), and Dicts of them, the observation space is {space}. Wrap the "
            "environment in gymnasium.wrappers.FlattenObservation."
        )
    if len(space.shape) not in (1, 3):
        raise ValueError(
            f"Dreamer reads images (3-D) and vectors (1-D), the observation space is {space}. Wrap the environment in "
            "gymnasium.wrappers.FlattenObservation or gymnasium.wrappers.ReshapeObservation."
        )
    return spaces.Dict({OBSERVATION: space})


def as_dict(observation: np.ndarray | Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """An observation, or many of them, of a space that :func:`as_dict_space` turned into a Dict."""
    return observation if isinstance(observation, Mapping) else {OBSERVATION: observation}


class Keyed:
    """
    What SB3 stores Box observations through: the buffer of a Dict with one key.

    :param buffer: it
    """

    def __init__(self, buffer: Any) -> None:
        self.buffer = buffer

    def add(self, obs: np.ndarray, next_obs: np.ndarray, *rest: Any) -> None:
        """As ``ReplayBuffer.add``."""
        self.buffer.add(as_dict(obs), as_dict(next_obs), *rest)
