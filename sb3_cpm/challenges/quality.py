"""
Challenge quality: how promising is each state of a trajectory as the goal of a challenge?

Report, section 4.4.1 and appendix B.5.1.
"""

from typing import Any

import numpy as np

from sb3_cpm.challenges.targeting import DynamicCoefficient


class ChallengeQuality:
    """
    Uncertainty u = c1 * KL + DISAG and score S = c * r + u, with both coefficients following their targets.

    :param kl_ratio: target of mean(c1 * KL) over mean(DISAG), report: 0.1
    :param reward_ratio: c*, target of mean(c * r) over mean(u), report: 0.75
    :param coefficient_kwargs: passed to both :class:`~sb3_cpm.challenges.targeting.DynamicCoefficient`
    """

    def __init__(self, kl_ratio: float = 0.1, reward_ratio: float = 0.75, coefficient_kwargs: dict[str, Any] | None = None):
        self.c1 = DynamicCoefficient(kl_ratio, **(coefficient_kwargs or {}))
        self.c = DynamicCoefficient(reward_ratio, **(coefficient_kwargs or {}))

    def uncertainty(self, disagreement: np.ndarray, kl: np.ndarray, first: int) -> np.ndarray:
        """
        :param disagreement: DISAG of every transition, shape ``(n_steps,)``
        :param kl: KL of every transition, shape ``(n_steps,)``
        :param first: index of the first counted transition; earlier ones don't move c1
        :return: u, shape ``(n_steps,)``
        """
        return self.c1.update(kl[first:], disagreement[first:]) * kl + disagreement

    def score(self, rewards: np.ndarray, uncertainty: np.ndarray, first: int) -> np.ndarray:
        """
        :param rewards: task reward of every transition, measured from the origin, shape ``(n_steps,)``
        :param uncertainty: u of every transition, shape ``(n_steps,)``
        :param first: index of the first counted transition; earlier ones don't move c
        :return: S, shape ``(n_steps,)``
        """
        return self.c.update(rewards[first:], uncertainty[first:]) * rewards + uncertainty


def best_goal(score: np.ndarray, first: int) -> int:
    """
    :param score: S of every transition, shape ``(n_steps,)``
    :param first: index of the first counted transition, < n_steps
    :return: index g of the best counted transition (the first one of several equals); its goal is the state s_{g+1}
    """
    return first + int(np.argmax(score[first:]))
