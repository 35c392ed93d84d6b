"""
Challenge filter with self-balancing strictness: is a candidate worth keeping?

Report, section 4.4.2 and appendix B.5.2. Five criteria; at least two of the first three and both of the last must hold.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sb3_cpm.arguments import ABOVE_0, SHARE, check, check_each, choice
from sb3_cpm.challenges.origin import measured

#: The criteria in the report's order, F1 to F5.
CRITERIA = ("novel", "relevant", "highlight", "sane", "not_first")


class Tolerance:
    """
    A positive number that settles where its criterion accepts a wanted share of the candidates.

    :param initial: start value
    :param looser: +1 if a larger value makes the criterion easier, -1 if a smaller one does
    :param gamma: strictness factor gamma_F, slightly above 1
    :param target_acceptance: share p of accepted candidates at which the tolerance settles: it is loosened by gamma^p on
        a rejection and tightened by gamma^(1-p) on an acceptance, which balances where acceptances come with probability p
    """

    #: The exponent of a tolerance that one side always wins (rewards that are zero for ever, say) must not overflow.
    MIN, MAX = 1e-6, 1e6

    def __init__(self, initial: float, looser: int, gamma: float = 1.05, target_acceptance: float = 0.5):
        if not initial > 0:
            raise ValueError(f"A tolerance must be positive, got {initial}")
        if not gamma > 1:
            raise ValueError(f"gamma (strictness factor) must be greater than 1 and close to it, got {gamma}")
        if not 0 < target_acceptance < 1:
            raise ValueError(f"target_acceptance must lie strictly between 0 and 1, got {target_acceptance}")
        self.value = float(initial)
        self._loosen = gamma ** (looser * target_acceptance)
        self._tighten = gamma ** (-looser * (1 - target_acceptance))

    def update(self, accepted: bool) -> None:
        """Stricter after an acceptance, looser after a rejection."""
        self.value = float(np.clip(self.value * (self._tighten if accepted else self._loosen), self.MIN, self.MAX))


@dataclass(frozen=True)
class CandidateStatistics:
    """
    What the criteria look at. Means are over the counted transitions of the whole trajectory, rewards measured from the
    origin.

    :param mean_reward: r_bar - o
    :param scaled_reward: c * (r_bar - o)
    :param mean_uncertainty: u_bar
    :param mean_score: S_bar
    :param goal_score: S_g
    :param goal: index g of the goal transition
    :param first: index of the first counted transition
    :param origin: o, see :class:`~sb3_cpm.challenges.origin.RewardOrigin`
    """

    mean_reward: float
    scaled_reward: float
    mean_uncertainty: float
    mean_score: float
    goal_score: float
    goal: int
    first: int
    origin: float = 0.0


class ChallengeFilter:
    """
    F1 to F5 with the reward memory and the three self-balancing tolerances.

    F1 follows the report's sentence ("negligible refers to falling short of r_bar by a tolerance factor"), not its
    printed formula, which has the tolerance on the other side and would be stricter the larger w1 is. F2 and F3 are
    written so that they mean the same for negative values: tolerance is then measured by the magnitude.

    A tolerance moves only where it has a say. Rewards of zero, for example, are novel enough whatever w1 is: let them move it,
    and it would run to the end of its range and hold nothing back, or everything, for hundreds of candidates once there are
    rewards.

    :param reward_ratio: c*, the target ratio of the challenge quality, report: 0.75
    :param novelty_tolerance: w1 at the start, report: 2.0
    :param relevance_tolerance: w2 at the start, report: 8.0
    :param highlight_tolerance: w3 at the start, report: 2.0
    :param gamma: strictness factor of all three tolerances
    :param target_acceptance: share of candidates that each of F1 to F3 accepts once settled
    :param reward_memory_decay: gamma_r of the mean reward memory, report: 0.99
    :param reward_memory_update: ``"trajectory"``: r_new is the mean reward of each trajectory in turn; ``"call"``: of all that
        came together (several environments), once for all of them, before any is judged (the report)
    :param self_balancing: ``"decisive"``: a tolerance moves where some value of it would have decided otherwise;
        ``"always"``: after every candidate (the report)
    :raises ValueError: for settings that cannot work
    """

    def __init__(
        self,
        reward_ratio: float = 0.75,
        novelty_tolerance: float = 2.0,
        relevance_tolerance: float = 8.0,
        highlight_tolerance: float = 2.0,
        gamma: float = 1.05,
        target_acceptance: float = 0.5,
        reward_memory_decay: float = 0.99,
        reward_memory_update: Literal["trajectory", "call"] = "trajectory",
        self_balancing: Literal["decisive", "always"] = "decisive",
    ):
        check_each(
            ABOVE_0,
            novelty_tolerance=novelty_tolerance,
            relevance_tolerance=relevance_tolerance,
            highlight_tolerance=highlight_tolerance,
            gamma=gamma,
        )
        check_each(SHARE, target_acceptance=target_acceptance, reward_memory_decay=reward_memory_decay)
        if reward_memory_decay == 1:
            raise ValueError(f"reward_memory_decay must lie in [0, 1), got {reward_memory_decay}")
        check("reward_memory_update", reward_memory_update, choice("trajectory", "call"))
        self.reward_memory_update = reward_memory_update
        check("self_balancing", self_balancing, choice("decisive", "always"))
        self.self_balancing = self_balancing
        self.reward_ratio = reward_ratio
        self.w1 = Tolerance(novelty_tolerance, looser=+1, gamma=gamma, target_acceptance=target_acceptance)
        self.w2 = Tolerance(relevance_tolerance, looser=+1, gamma=gamma, target_acceptance=target_acceptance)
        self.w3 = Tolerance(highlight_tolerance, looser=-1, gamma=gamma, target_acceptance=target_acceptance)
        self.reward_memory_decay = reward_memory_decay
        self.reward_memory: float | None = None

    def remember(self, mean_reward: float) -> None:
        """
        r_mem <- decay * r_mem + (1 - decay) * r_new; the first value is taken as it is.

        :param mean_reward: r_new, mean reward of the new trajectories
        """
        if self.reward_memory is None:
            self.reward_memory = mean_reward
        else:
            self.reward_memory += (1 - self.reward_memory_decay) * (mean_reward - self.reward_memory)

    def verdicts(self, candidate: CandidateStatistics) -> dict[str, bool]:
        """
        :param candidate: statistics of the trajectory and its goal
        :return: for each of :data:`CRITERIA`, whether it would keep the candidate
        """
        return {
            **{name: bool(holds(tolerance.value)) for name, tolerance, holds in self._tolerant(candidate)},
            "sane": candidate.goal_score > 0,
            "not_first": candidate.goal > candidate.first,
        }

    def _tolerant(self, candidate: CandidateStatistics) -> list[tuple[str, Tolerance, Callable[[float], bool]]]:
        """:return: F1 to F3, each with its tolerance and as a function of that"""
        memory = candidate.mean_reward if self.reward_memory is None else measured(self.reward_memory, candidate.origin)

        def novel(w1: float) -> bool:  # c * r_bar <= w1 * c* * u_bar
            return candidate.scaled_reward <= w1 * self.reward_ratio * candidate.mean_uncertainty

        def relevant(w2: float) -> bool:
            # w2 * r_bar >= r_mem for a positive memory: r_bar may fall below it by the share 1 - 1/w2 of its magnitude
            return candidate.mean_reward >= memory - (1 - 1 / w2) * abs(memory)

        def highlight(w3: float) -> bool:  # S_g >= w3 * S_bar for a positive mean score
            return candidate.goal_score - candidate.mean_score >= (w3 - 1) * abs(candidate.mean_score)

        return [("novel", self.w1, novel), ("relevant", self.w2, relevant), ("highlight", self.w3, highlight)]

    def judge(self, candidate: CandidateStatistics) -> tuple[bool, dict[str, bool]]:
        """
        Decide on a candidate, then move the three tolerances by what their own criteria said.

        :param candidate: statistics of the trajectory and its goal
        :return: whether it is kept, and the verdict of each criterion
        """
        verdicts = self.verdicts(candidate)
        majority = verdicts["novel"] + verdicts["relevant"] + verdicts["highlight"] >= 2
        for name, tolerance, holds in self._tolerant(candidate):
            if self.self_balancing == "always" or holds(Tolerance.MIN) != holds(Tolerance.MAX):
                tolerance.update(verdicts[name])
        return majority and verdicts["sane"] and verdicts["not_first"], verdicts
