"""
Observations stored once.

``DictReplayBuffer`` keeps every observation twice, as ``obs`` of one transition and as ``next_obs`` of the one before.
Within an episode they are the same array, so the next observation of a transition is read here from the following slot;
only the last observation of an episode, which no transition starts from, needs a place of its own.

The next observation of the newest transition has no slot yet: the following ``add()`` brings it once more, as ``obs``. Until
then it waits beside the ring. An example of four slots::

    row       0    1    2    3
              s5   s1   s2   s3      the newest transition, (s5, s6), is in row 0: s6 waits
              s5   s6   s2   s3      now (s6, s7) is in row 1: s7 waits, and the episode that s1 began is forgotten
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from sb3_cpm.buffers.allocation import Allocate
from sb3_cpm.buffers.compact import Codec


@dataclass(frozen=True)
class Episode:
    """
    A complete episode in D, or among the demonstrations beside it.

    :param env_idx: environment that it was played in
    :param start: slot of its first transition in the ring
    :param length: number of transitions
    :param ordinal: how many episodes of this environment came before it
    :param demonstrated: it is among the demonstrations
    """

    env_idx: int
    start: int
    length: int
    ordinal: int
    demonstrated: bool = False

    def slots(self, buffer_size: int) -> np.ndarray:
        """Slots of its transitions in a ring of ``buffer_size``, shape ``(length,)``."""
        return np.arange(self.start, self.start + self.length) % buffer_size


class Locations(NamedTuple):
    """
    Where ``n`` transitions are; made once and used for every key.

    :param here: flat slots (row * n_envs + environment) of the transitions and their observations
    :param envs: their environments
    :param starts: rows that their episodes start in
    :param steps: their numbers within their episodes
    :param lengths: lengths of their episodes, 0 for unfinished ones
    :param following: flat slots of their next observations, where those are in the ring
    :param ended: which of the n end an episode, so that their next observation is among the final ones
    :param final: the slots there, one for each of ``ended``
    """

    here: np.ndarray
    envs: np.ndarray
    starts: np.ndarray
    steps: np.ndarray
    lengths: np.ndarray
    following: np.ndarray
    ended: np.ndarray
    final: np.ndarray


class FinalObservations:
    """
    One slot for the last observation of every episode, per observation key; grows as needed, slots are reused.

    :param codecs: how each key is stored
    :param allocate: makes the arrays
    """

    def __init__(self, codecs: Mapping[str, Codec], allocate: Allocate):
        self._allocate = allocate
        self.arrays = {
            key: allocate(f"final_{key}", (0, *codec.stored_shape), codec.stored_dtype) for key, codec in codecs.items()
        }
        self._free: list[int] = []

    def reserve(self, n: int) -> None:
        """Make sure that ``n`` observations can be stored. Only this can fail, for want of memory or disk."""
        if len(self._free) >= n:
            return
        used = len(next(iter(self.arrays.values())))
        grown = used + max(16, n, used // 4)
        self.resize(grown)
        self._free.extend(range(grown - 1, used - 1, -1))

    def resize(self, size: int) -> None:
        """Room for as many observations; those that there are stay in their slots, and which slots are free is not changed."""
        arrays = {}
        for key, array in self.arrays.items():
            arrays[key] = self._allocate(f"final_{key}", (size, *array.shape[1:]), array.dtype)
            arrays[key][: len(array)] = array
        self.arrays = arrays

    def store(self, observation: Mapping[str, np.ndarray]) -> int:
        """
        :param observation: one stored observation, without environment dimension
        :return: its slot
        """
        self.reserve(1)
        slot = self._free.pop()
        for key, array in self.arrays.items():
            array[slot] = observation[key]
        return slot

    def free(self, slot: int) -> None:
        self._free.append(slot)

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values())


class ObservationRing:
    """
    The ring of observations behind a replay buffer, with what is needed to read next observations from it.

    :param size: slots per environment
    :param n_envs: number of environments
    :param codecs: how each key is stored
    :param allocate: makes the arrays
    """

    def __init__(self, size: int, n_envs: int, codecs: dict[str, Codec], allocate: Allocate):
        self.size = size
        self.n_envs = n_envs
        self.codecs = codecs
        self._allocate = allocate
        #: In stored form, each of shape ``(size, n_envs, *stored_shape)``
        self.observations = {
            key: allocate(key, (size, n_envs, *codec.stored_shape), codec.stored_dtype) for key, codec in codecs.items()
        }
        self.final = FinalObservations(codecs, allocate)
        #: First row and length of each transition's episode, shape ``(size, n_envs, 2)``; length 0 is "not to be sampled"
        self.spans = np.zeros((size, n_envs, 2), dtype=np.int64)
        # slot in `final` of the transition's next observation, -1: it is in the following slot of the ring
        self.final_slot = np.full((size, n_envs), -1, dtype=np.int32)
        self._waiting = {key: np.zeros((n_envs, *codec.stored_shape), codec.stored_dtype) for key, codec in codecs.items()}
        self.newest_row = -1
        self._compact = [key for key, codec in codecs.items() if not codec.as_it_is]
        self._waiting_bytes: dict[str, bytes] = {}  # of compact keys: as they were given
        self._layout = [(key, (n_envs, *codec.shape), codec.dtype, codec) for key, codec in codecs.items()]
        self._link()

    def _link(self) -> None:
        self._flat = {
            key: array.reshape(self.size * self.n_envs, *array.shape[2:]) for key, array in self.observations.items()
        }
        self._flat_final_slot = self.final_slot.reshape(-1)
        self._flat_spans = self.spans.reshape(-1, 2)

    # ------------------------------------------------------------------ writing

    def encode(self, observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        :param observations: of all environments
        :return: in stored form, not copied where they have it
        :raises ValueError: for wrong shapes and values that the storage cannot hold
        """
        encoded = {}
        if not isinstance(observations, Mapping):
            raise ValueError(
                f"Observations must be dicts of arrays with the keys {sorted(self.codecs)}, got {type(observations).__name__}."
            )
        for key, shape, dtype, codec in self._layout:
            try:
                array = observations[key]
            except KeyError:
                raise ValueError(f"The observations lack {key!r}; the observation space has {sorted(self.codecs)}") from None
            if not (codec.as_it_is and type(array) is np.ndarray and array.shape == shape and array.dtype == dtype):
                array = codec.encode(array, self.n_envs)
            encoded[key] = array
        return encoded

    def goes_on_with(self, observations: Mapping[str, np.ndarray]) -> bool:
        """
        :param observations: of all environments, for the next transitions
        :return: whether they are, byte by byte, those that wait
        """
        if self.newest_row < 0 or not isinstance(observations, Mapping):
            return False
        for key, waiting in self._waiting.items():
            given = observations.get(key)
            if type(given) is not np.ndarray:
                return False
            if key in self._compact:  # cheaper than to encode it again, and to compare then
                if self._waiting_bytes.get(key) != given.tobytes():
                    return False
            elif not _same_bytes(waiting, given):
                return False
        return True

    def write(self, row: int, encoded: Mapping[str, np.ndarray] | None) -> None:
        """
        :param row: slot of the next transitions
        :param encoded: their observations; None: those that wait
        """
        if encoded is None:
            encoded = self._waiting
        for key, array in self.observations.items():
            array[row] = encoded[key]

    def write_next(self, row: int, encoded: Mapping[str, np.ndarray], given: Mapping[str, np.ndarray]) -> None:
        """
        :param row: slot of the newest transitions
        :param encoded: the observations that they led to
        :param given: the same before encoding
        """
        for key, array in self._waiting.items():
            array[...] = encoded[key]
        for key in self._compact:
            self._waiting_bytes[key] = np.asarray(given[key]).tobytes()
        self.newest_row = row

    def newest(self, env_idx: int) -> dict[str, np.ndarray]:
        """:return: what the newest transition of an environment led to, in stored form"""
        return {key: array[env_idx] for key, array in self._waiting.items()}

    def continues(self, env_idx: int, encoded: Mapping[str, np.ndarray]) -> bool:
        """Whether an environment's observation is the one that its newest transition led to, NaN being equal to NaN."""
        return all(_same(array, encoded[key][env_idx]) for key, array in self.newest(env_idx).items())

    def end_episode(self, row: int, env_idx: int) -> None:
        """The newest transition of an environment, in slot ``row``, was the last of its episode: keep its next observation."""
        self.final_slot[row, env_idx] = self.final.store(self.newest(env_idx))

    def drop_episode(self, last_row: int, env_idx: int) -> None:
        """An episode, whose last transition is in slot ``last_row``, is about to be overwritten."""
        self.final.free(int(self.final_slot[last_row, env_idx]))
        self.final_slot[last_row, env_idx] = -1

    # ------------------------------------------------------------------ reading

    def locate(self, rows: np.ndarray, envs: np.ndarray) -> Locations:
        """
        :param rows: slots of transitions, shape ``(n,)``
        :param envs: their environments, shape ``(n,)``
        """
        here = rows * self.n_envs + envs
        # whether a transition ends its episode is known from what hindsight needs anyway, without another random access
        starts, lengths = self._flat_spans.take(here, axis=0).T
        steps = rows - starts
        steps[steps < 0] += self.size
        return self._located(here, envs, starts, steps, lengths)

    def locate_later(self, at: Locations, steps: np.ndarray) -> Locations:
        """:return: other transitions of the same episodes, by their numbers"""
        rows = at.starts + steps
        rows[rows >= self.size] -= self.size
        return self._located(rows * self.n_envs + at.envs, at.envs, at.starts, steps, at.lengths)

    def _located(
        self, here: np.ndarray, envs: np.ndarray, starts: np.ndarray, steps: np.ndarray, lengths: np.ndarray
    ) -> Locations:
        n_slots = self.size * self.n_envs
        following = here + self.n_envs
        following[following >= n_slots] -= n_slots
        ended = (steps == lengths - 1).nonzero()[0]
        final = self._flat_final_slot.take(here.take(ended))
        return Locations(here, envs, starts, steps, lengths, following, ended, final)

    def read(self, key: str, at: Locations) -> np.ndarray:
        """:return: observations (a copy) in the space's dtype, shape ``(n, *observation_shape)``"""
        return self.codecs[key].decode(self._flat[key].take(at.here, axis=0))

    def read_next(self, key: str, at: Locations) -> np.ndarray:
        """:return: next observations (a copy) in the space's dtype, shape ``(n, *observation_shape)``"""
        result = self._flat[key].take(at.following, axis=0)
        if len(at.ended):
            result[at.ended] = self.final.arrays[key].take(at.final, axis=0)
        return self.codecs[key].decode(result)

    def read_newest(self, key: str, envs: np.ndarray) -> np.ndarray:
        """:return: the next observations of the newest transitions of some environments"""
        return self.codecs[key].decode(self._waiting[key][envs])

    @property
    def nbytes(self) -> int:
        """Bytes that are taken now: the ring, the last observations of episodes, and the books."""
        ring = sum(array.nbytes for array in self.observations.values())
        return ring + self.final.nbytes + self.final_slot.nbytes + self.spans.nbytes

    # ------------------------------------------------------------------ saving

    def books(self) -> dict[str, Any]:
        """What is no large array, for :meth:`restore_books`."""
        return {
            "newest_row": self.newest_row,
            "waiting": self._waiting,
            "waiting_bytes": self._waiting_bytes,
            "final_slots": len(next(iter(self.final.arrays.values()))),
            "free": self.final._free,
        }

    def restore_books(self, books: Mapping[str, Any]) -> None:
        """
        :param books: of a ring like this one; what :meth:`arrays` then gives has their sizes
        """
        self.newest_row, self._waiting_bytes = books["newest_row"], books["waiting_bytes"]
        for key, array in self._waiting.items():
            array[...] = books["waiting"][key]
        self.final.resize(books["final_slots"])
        self.final._free = books["free"]

    def arrays(self, used: int) -> dict[str, np.ndarray]:
        """
        :param used: rows that have been written
        :return: the large arrays up to there by name, the ones that are used and no copies
        """
        stores = {"observations": {key: array[:used] for key, array in self.observations.items()}, "final": self.final.arrays}
        found = {f"{store}/{quote(key, '')}": array for store, arrays in stores.items() for key, array in arrays.items()}
        return {**found, "spans": self.spans[:used], "final_slot": self.final_slot[:used]}

    # ------------------------------------------------------------------ pickling

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_flat"], state["_flat_final_slot"], state["_flat_spans"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for store, arrays in (("", self.observations), ("final_", self.final.arrays)):
            for key, array in arrays.items():  # memory-mapped arrays come back as plain ones: put them into files again
                if isinstance(array, np.memmap):
                    arrays[key] = self._allocate(f"{store}{key}", array.shape, array.dtype)
                    arrays[key][...] = array
        self._link()


class NextObservationView:
    """
    Stands where ``DictReplayBuffer`` has an array of next observations, for one key: reads them from the ring.

    :param ring: where the observations are
    :param key: observation key
    """

    def __init__(self, ring: ObservationRing, key: str):
        self._ring = ring
        self._key = key
        self.shape = (ring.size, ring.n_envs, *ring.codecs[key].shape)
        self.dtype = ring.codecs[key].dtype

    def __getitem__(self, index: Any) -> np.ndarray:
        ring = self._ring
        index = index if isinstance(index, tuple) else (index,)
        # the first two indices, of whatever kind, choose transitions; numpy works out which
        numbers = np.arange(ring.size * ring.n_envs).reshape(ring.size, ring.n_envs)[index[:2]]
        rows, envs = np.divmod(numbers.reshape(-1), ring.n_envs)
        values = ring.read_next(self._key, ring.locate(rows, envs))
        newest = (rows == ring.newest_row) & (ring.spans[rows, envs, 1] == 0)
        values[newest] = ring.read_newest(self._key, envs[newest])
        values = values.reshape(*numbers.shape, *self.shape[2:])
        return values[(slice(None),) * numbers.ndim + index[2:]] if len(index) > 2 else values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype=dtype)


def _same_bytes(stored: np.ndarray, given: np.ndarray) -> bool:
    if stored.nbytes < 1 << 16 or not given.flags.c_contiguous or given.dtype != stored.dtype:
        return stored.tobytes() == given.tobytes()  # two copies and memcmp: cheaper than what NumPy has, unless it is large
    return bool((stored.reshape(-1).view(np.uint8) == given.reshape(-1).view(np.uint8)).all())


def _same(stored: np.ndarray, given: np.ndarray) -> bool:
    if stored.tobytes() == given.tobytes():
        return True
    if stored.dtype.kind != "f":
        return False
    return np.array_equal(stored, given, equal_nan=True)
