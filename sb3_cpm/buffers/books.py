"""
Which slots of a ring hold which complete episodes.

Complete episodes of an environment lie one after another in the ring and end where the unfinished one starts, so a transition
is drawn by a random number below their total length. Two environments, six slots, e being transitions of complete episodes, u
of unfinished ones::

    slot            0  1  2  3  4  5
    environment 0   e  e  e  u  u  .     3 to draw from, the oldest in slot 0
    environment 1   e  u  u  u  u  .     1, in slot 0: numbers 0 to 3 are the transitions to draw from
"""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from sb3_cpm.buffers.storage import Episode

#: Arrays of the books, by their names in files.
_ARRAYS = ("current_ep_start", "n_episodes", "n_valid", "began")


class EpisodeBooks:
    """
    Knows where episodes lie and nothing of what is in them.

    :param size: slots per environment
    :param n_envs: number of environments
    """

    def __init__(self, size: int, n_envs: int) -> None:
        self.size, self.n_envs = size, n_envs
        #: rows that were written, of all environments at once; the next one is slot ``n_steps % size``
        self.n_steps = 0
        #: slots in which the unfinished episodes start, where the complete ones end
        self.current_ep_start = np.zeros(n_envs, dtype=np.int64)
        #: transitions of complete episodes, per environment
        self.n_valid = np.zeros(n_envs, dtype=np.int64)
        self.n_episodes = np.zeros(n_envs, dtype=np.int64)  # that ever ended
        self.began = np.zeros(n_envs, dtype=np.int64)  # number of the step that the unfinished episodes began with
        self._episodes: list[deque[Episode]] = [deque() for _ in range(n_envs)]
        # environments whose oldest, second oldest, ... complete episode starts in a slot
        self._starts: dict[int, list[int]] = {}
        self._count()

    def _count(self) -> None:
        """What follows from the arrays and is asked for at every step or batch."""
        self._valid_ends = np.cumsum(self.n_valid)
        self._earliest_began = int(self.began.min())

    # ------------------------------------------------------------------ looking

    @property
    def episodes(self) -> list[Episode]:
        """Complete episodes, by environment, oldest first."""
        return [episode for episodes in self._episodes for episode in episodes]

    @property
    def n_drawable(self) -> int:
        """Transitions of complete episodes, of all environments."""
        return int(self._valid_ends[-1])

    @property
    def unfinished(self) -> list[int]:
        """Environments that are in the middle of an episode."""
        return np.flatnonzero(self.began < self.n_steps).tolist()

    @property
    def is_filled_by_one(self) -> bool:
        """Whether an unfinished episode takes all slots of its environment."""
        return self.n_steps - self._earliest_began >= self.size

    @property
    def longest_unfinished(self) -> int:
        """Environment of the unfinished episode that began first."""
        return int(np.argmin(self.began))

    def oldest(self, envs: np.ndarray) -> np.ndarray:
        """:return: slots of the oldest transitions of complete episodes; negative ones count back from the ring's end"""
        return self.current_ep_start[envs] - self.n_valid[envs]

    def holds(self, episode: Episode) -> bool:
        """Whether a complete episode is still there."""
        episodes = self._episodes[episode.env_idx]
        return bool(episodes) and episodes[0].ordinal <= episode.ordinal <= episodes[-1].ordinal

    def draw(self, n: int, n_first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """
        :param n: number of transitions
        :param n_first: the first so many are for another purpose than the rest
        :return: slots (negative ones count back from the end of the ring) and environments of n transitions of complete
            episodes, with replacement, each shape ``(n,)``
        """
        if n == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        ends = self._valid_ends
        picks = np.random.randint(ends[-1], size=n)
        # In the order of memory, reading a large ring takes a seventh less time; the order within a batch means nothing.
        picks[:n_first].sort()
        picks[n_first:].sort()
        if self.n_envs == 1:
            return picks + (self.current_ep_start[0] - ends[0]), np.zeros(n, dtype=np.int64)
        envs = ends.searchsorted(picks, side="right")
        # oldest + (pick - ends of the environment before)
        return picks + (self.current_ep_start - ends).take(envs), envs

    # ------------------------------------------------------------------ writing

    def end(self, env_idx: int) -> Episode:
        """:return: the episode of an environment that ends with the newest transition"""
        start, length = int(self.current_ep_start[env_idx]), self.n_steps - int(self.began[env_idx])
        episode = Episode(env_idx, start, length, ordinal=int(self.n_episodes[env_idx]))
        self.current_ep_start[env_idx] = self.n_steps % self.size
        self.began[env_idx] = self.n_steps
        self.n_episodes[env_idx] += 1
        self.n_valid[env_idx] += length
        self._episodes[env_idx].append(episode)
        self._starts.setdefault(start, []).append(env_idx)
        self._count()
        return episode

    def overwrite(self, slot: int) -> list[Episode]:
        """:return: the episodes whose first slot this is: it is about to be overwritten, and they are struck out"""
        if slot not in self._starts:
            return []
        gone = [self._episodes[env_idx].popleft() for env_idx in self._starts.pop(slot)]
        for episode in gone:
            assert episode.start == slot
            self.n_valid[episode.env_idx] -= episode.length
        self._count()
        return gone

    # ------------------------------------------------------------------ files

    def state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """:return: plain numbers and lists by name (``episodes`` beside them is :attr:`episodes`), and arrays"""
        starts = [[slot, envs] for slot, envs in self._starts.items()]
        return {"n_steps": self.n_steps, "starts": starts}, {name: getattr(self, name) for name in _ARRAYS}

    def restore(
        self, n_steps: int, starts: Iterable[tuple[int, list[int]]], episodes: Iterable[Episode], **arrays: np.ndarray
    ) -> None:
        """
        The opposite of :meth:`state`, for empty books.

        :param n_steps: see the class
        :param starts: slots with the environments whose episodes start there
        :param episodes: complete ones, each environment's oldest first
        :param arrays: those of :meth:`state`
        """
        self.n_steps = n_steps
        self._starts = {slot: list(envs) for slot, envs in starts}
        for episode in episodes:
            self._episodes[episode.env_idx].append(episode)
        for name in _ARRAYS:
            setattr(self, name, arrays[name])
        self._count()
