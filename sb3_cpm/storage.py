"""
Observations stored once.

``DictReplayBuffer`` keeps every observation twice, as ``obs`` of one transition and as ``next_obs`` of the one before.
Within an episode they are the same array, so the next observation of a transition is read here from the following slot;
only the last observation of an episode, which no transition starts from, needs a place of its own.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np


class FinalObservations:
    """
    One slot for the last observation of every episode, per observation key; grows as needed, slots are reused.

    :param shapes: observation shape per key
    :param dtypes: dtype per key
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], dtypes: Mapping[str, Any]):
        self.arrays = {key: np.zeros((0, *shape), dtype=dtypes[key]) for key, shape in shapes.items()}
        self._free: list[int] = []

    def store(self, observation: Mapping[str, np.ndarray]) -> int:
        """
        :param observation: one observation, without environment dimension
        :return: its slot
        """
        if not self._free:
            self._grow()
        slot = self._free.pop()
        for key, array in self.arrays.items():
            array[slot] = observation[key]
        return slot

    def free(self, slot: int) -> None:
        self._free.append(slot)

    def _grow(self) -> None:
        used = len(next(iter(self.arrays.values())))
        grown = max(16, 2 * used)
        for key, array in self.arrays.items():
            self.arrays[key] = np.zeros((grown, *array.shape[1:]), dtype=array.dtype)
            self.arrays[key][:used] = array
        self._free.extend(range(grown - 1, used - 1, -1))


class ObservationRing:
    """
    The ring of observations behind a replay buffer, with what is needed to read next observations from it.

    :param size: slots per environment
    :param n_envs: number of environments
    :param shapes: observation shape per key
    :param dtypes: dtype per key
    """

    def __init__(self, size: int, n_envs: int, shapes: Mapping[str, tuple[int, ...]], dtypes: Mapping[str, Any]):
        self.size = size
        self.observations = {key: np.zeros((size, n_envs, *shape), dtype=dtypes[key]) for key, shape in shapes.items()}
        self.final = FinalObservations(shapes, dtypes)
        # slot in `final` of the transition's next observation, -1: it is in the following slot of the ring
        self.final_slot = np.full((size, n_envs), -1, dtype=np.int32)
        # the next observations of the newest transitions have no slot yet: the following add() brings them as `obs`
        self.newest_next = {key: np.zeros((n_envs, *shape), dtype=dtypes[key]) for key, shape in shapes.items()}
        self.newest_row = -1

    def end_episode(self, row: int, env_idx: int) -> None:
        """The newest transition of an environment, in slot ``row``, was the last of its episode: keep its next observation."""
        self.final_slot[row, env_idx] = self.final.store({key: array[env_idx] for key, array in self.newest_next.items()})

    def drop_episode(self, last_row: int, env_idx: int) -> None:
        """An episode, whose last transition is in slot ``last_row``, is about to be overwritten."""
        self.final.free(int(self.final_slot[last_row, env_idx]))
        self.final_slot[last_row, env_idx] = -1

    def continues(self, env_idx: int, obs: Mapping[str, np.ndarray]) -> bool:
        """Whether an environment's observation is the one that its newest transition led to."""
        return all(_same(array[env_idx], obs[key][env_idx]) for key, array in self.newest_next.items())

    def next_observation(self, key: str, rows: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """
        :param key: observation key
        :param rows: slots of transitions, shape ``(n,)``
        :param envs: their environments, shape ``(n,)``
        :return: next observations (a copy), shape ``(n, *observation_shape)``
        """
        ring = self.observations[key]
        result = ring[(rows + 1) % self.size, envs]
        slots = self.final_slot[rows, envs]
        ended = slots >= 0
        if ended.any():
            result[ended] = self.final.arrays[key][slots[ended]]
        newest = (rows == self.newest_row) & ~ended
        if newest.any():
            result[newest] = self.newest_next[key][envs[newest]]
        return result

    @property
    def nbytes(self) -> int:
        """Bytes of the ring itself when it is full, without the last observations of episodes."""
        return sum(array.nbytes for array in self.observations.values())


class NextObservationView:
    """
    Stands where ``DictReplayBuffer`` has an array of next observations, for one key: reads them from the ring.

    :param ring: where the observations are
    :param key: observation key
    """

    def __init__(self, ring: ObservationRing, key: str):
        self._ring = ring
        self._key = key

    def __getitem__(self, index: tuple[Any, ...]) -> np.ndarray:
        rows, envs = np.broadcast_arrays(np.atleast_1d(index[0]), np.atleast_1d(index[1]))
        return self._ring.next_observation(self._key, rows, envs)

    def __setitem__(self, row: int, observations: np.ndarray) -> None:
        self._ring.newest_next[self._key][...] = observations
        self._ring.newest_row = row


def _same(stored: np.ndarray, given: np.ndarray) -> bool:
    """Equality after storage: in the stored dtype and shape, NaN being equal to NaN."""
    given = np.asarray(given, dtype=stored.dtype).reshape(stored.shape)
    return np.array_equal(stored, given) or (stored.dtype.kind == "f" and np.array_equal(stored, given, equal_nan=True))
