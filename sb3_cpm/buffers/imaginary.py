"""
The imaginary buffer I: challenges as views into D (report, sections 3.2.1 and 4.3).

A challenge holds positions in D, rewards of its own and what it was chosen for, no observations. It ends with its episode,
or lives on among the demonstrations, which are never overwritten.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from sb3_cpm.buffers.storage import Episode
from sb3_cpm.challenges import CRITERIA, REWARD_TERMS, Proposal

#: Attributes of I that come from the buffer's arguments or are made when they are needed.
_GIVEN = {"buffer_size", "max_challenges", "_index"}


@dataclass(frozen=True)
class Challenge:
    """
    A challenge in I: transitions ``first`` to ``goal`` of an episode, with artificial rewards.

    :param episode: the episode in D, or among the demonstrations, that it is cut from
    :param proposal: its evaluation and its rewards
    :param number: how many challenges were kept before it
    :param added_at: number of transitions that D had been given when it was kept
    :param rewarded_at: likewise, when its rewards were computed: then, or at the last refresh
    :param age: transitions that D was given since ``rewarded_at``, at the time of asking
    """

    episode: Episode
    proposal: Proposal
    number: int
    added_at: int
    rewarded_at: int
    age: int = 0

    @property
    def environment(self) -> int:
        """The environment that it was played in."""
        return self.episode.env_idx

    @property
    def start(self) -> int:
        """Step of its episode that it starts with."""
        return self.proposal.first

    @property
    def goal(self) -> int:
        """Step of its episode that leads to its goal."""
        return self.proposal.goal

    @property
    def score(self) -> float:
        """Score S of its goal."""
        return float(self.proposal.score[self.goal])

    @property
    def terms(self) -> dict[str, np.ndarray]:
        """The four terms of its rewards, each times its coefficient, before halving, shape ``(goal - start + 1,)``."""
        artificial = self.proposal.artificial
        assert artificial is not None
        return {name: getattr(artificial, name) for name in REWARD_TERMS}

    @property
    def rewards(self) -> np.ndarray:
        """Its artificial rewards, shape ``(goal - start + 1,)``."""
        assert self.proposal.artificial is not None
        return self.proposal.artificial.total


@dataclass
class ChallengeCounters:
    """How many candidates there were, how many were kept, and how many each criterion alone would have rejected."""

    proposed: int = 0
    kept: int = 0
    rejected_by: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CRITERIA, 0))
    refreshed: int = 0

    def count(self, proposal: Proposal) -> None:
        self.proposed += 1
        self.kept += proposal.accepted
        for name, verdict in proposal.verdicts.items():
            self.rejected_by[name] += not verdict


class ImaginaryBuffer:
    """
    I itself.

    :param buffer_size: slots per environment in D
    :param max_challenges: the oldest makes room for one more
    """

    def __init__(self, buffer_size: int, max_challenges: int):
        self.buffer_size = buffer_size
        self.max_challenges = max_challenges
        self._challenges: deque[Challenge] = deque()
        self._n_kept = 0
        self._index: _Index | None = None
        self._age_sum = 0.0
        self._age_samples = 0

    def __len__(self) -> int:
        return len(self._challenges)

    def keep(self, episode: Episode, proposal: Proposal, now: int) -> None:
        """
        :param episode: the episode in D, or among the demonstrations
        :param proposal: an accepted one
        :param now: number of transitions that D has been given
        """
        if len(self._challenges) >= self.max_challenges:
            self._challenges.popleft()
        self._challenges.append(Challenge(episode, proposal, self._n_kept, added_at=now, rewarded_at=now))
        self._n_kept += 1
        self._index = None

    def replace(self, challenge: Challenge, proposal: Proposal, now: int) -> None:
        """
        Give a challenge new rewards.

        :raises ValueError: if it is no longer in I
        """
        for place, ours in enumerate(self._challenges):
            if ours.number == challenge.number:
                self._challenges[place] = replace(ours, proposal=proposal, rewarded_at=now)
                self._index = None
                return
        raise ValueError(f"Challenge number {challenge.number} is no longer in the buffer")

    def forget(self, episode: Episode) -> None:
        """D is about to overwrite an episode: the challenges that it holds end with it."""
        kept = [challenge for challenge in self._challenges if challenge.episode != episode]
        if len(kept) < len(self._challenges):
            self._challenges, self._index = deque(kept), None

    def inspect(self, now: int) -> list[Challenge]:
        """:return: the challenges, oldest first, their ages filled in"""
        return [replace(challenge, age=now - challenge.rewarded_at) for challenge in self._challenges]

    def sample(self, n: int, now: int) -> "ImaginaryRows":
        """
        :param n: number of transitions, drawn uniformly over all transitions of all challenges
        :param now: number of transitions that D has been given, for the ages
        """
        if self._index is None:
            self._index = _Index.of(self._challenges, self.buffer_size)
        index = self._index
        picks = np.random.randint(len(index.rewarded_at), size=n)
        self._age_sum += now - float(index.rewarded_at.take(picks).mean())
        self._age_samples += 1
        return ImaginaryRows(*(column.take(picks) for column in index.rows))

    def state(self) -> dict[str, Any]:
        """All that it holds, for :meth:`restore`."""
        return {name: value for name, value in vars(self).items() if name not in _GIVEN}

    def restore(self, state: Mapping[str, Any]) -> None:
        """:param state: of an imaginary buffer beside a D of the same size"""
        for name in vars(self).keys() - _GIVEN:
            setattr(self, name, state[name])
        self._index = None

    def pop_sampled_age(self) -> float | None:
        """:return: mean age of the rewards sampled since the last call, in transitions; None if there were none"""
        if not self._age_samples:
            return None
        age = self._age_sum / self._age_samples
        self._age_sum, self._age_samples = 0.0, 0
        return age


class ImaginaryRows(NamedTuple):
    """
    Transitions of challenges, each array of shape ``(n,)``.

    :param slots: where they are in D
    :param envs: their environments
    :param rewards: their artificial rewards
    :param is_goal: whether they lead to the goal
    :param goal_slots: of the transitions that lead to the goals of their challenges
    :param demonstrated: whether they, and these, are among the demonstrations instead
    """

    slots: np.ndarray
    envs: np.ndarray
    rewards: np.ndarray
    is_goal: np.ndarray
    goal_slots: np.ndarray
    demonstrated: np.ndarray

    def of(self, demonstrated: bool) -> "ImaginaryRows":
        """:return: those of one kind"""
        chosen = self.demonstrated == demonstrated
        return ImaginaryRows(*(column[chosen] for column in self))


@dataclass(frozen=True)
class _Index:
    """All transitions of I one after another, and when each was rewarded, shape ``(transitions in I,)``."""

    rows: ImaginaryRows
    rewarded_at: np.ndarray

    @classmethod
    def of(cls, challenges: Iterable[Challenge], buffer_size: int) -> "_Index":
        columns = []
        for challenge in challenges:
            steps = np.arange(challenge.start, challenge.goal + 1)
            slots = challenge.episode.start + steps
            if not challenge.episode.demonstrated:
                slots %= buffer_size
            columns.append(
                (
                    slots,
                    np.full(len(steps), challenge.environment),
                    challenge.rewards.astype(np.float32),
                    steps == challenge.goal,
                    np.full(len(steps), slots[-1]),
                    np.full(len(steps), challenge.episode.demonstrated),
                    np.full(len(steps), challenge.rewarded_at),
                )
            )
        *rows, rewarded_at = (np.concatenate(parts) for parts in zip(*columns, strict=True))
        return cls(ImaginaryRows(*rows), rewarded_at)
