"""
Where rewards are measured from, so that their sign does not decide.

Beyond the report, whose rewards are positive. Its formulas compare magnitudes of rewards with uncertainties: of rewards
around -1000 they would see nothing but the -1000, and a negative mean reward is never larger than any uncertainty.
"""

from typing import Literal, TypeVar

import numpy as np

from sb3_cpm.arguments import check, choice

OriginKind = Literal["low_quantile", "zero"]
Rewards = TypeVar("Rewards", float, np.ndarray)


class RewardOrigin:
    """
    The origin o: zero while rewards are positive, else a moving low quantile of them.

    Each trajectory has a level: its low quantile, or its mean where that is lower (few large penalties). o is the low
    quantile of the levels of the last :attr:`WINDOW` trajectories if that is negative, else 0. A constant added to all
    rewards so moves o by as much and leaves r - o as it is, as long as o stays negative.

    :param kind: ``"low_quantile"``, or ``"zero"``: rewards are taken as they are (the report)
    :raises ValueError: for another one
    """

    #: Share of rewards, and of trajectories, below the low quantile.
    QUANTILE = 0.1
    #: Trajectories that count, about as many as the reward memory remembers.
    WINDOW = 100

    def __init__(self, kind: OriginKind = "low_quantile"):
        check("reward_origin", kind, choice("low_quantile", "zero"))
        self.kind = kind
        #: Levels of the last trajectories, oldest first.
        self.levels: list[float] = []

    def remember(self, rewards: np.ndarray) -> None:
        """
        :param rewards: all task rewards of a new trajectory, shape ``(n_steps,)``
        """
        level = min(float(np.quantile(rewards, self.QUANTILE)), float(rewards.mean()))
        self.levels = [*self.levels, level][-self.WINDOW :]

    @property
    def value(self) -> float:
        """o, at most 0."""
        if self.kind == "zero" or not self.levels:
            return 0.0
        return min(0.0, float(np.quantile(self.levels, self.QUANTILE)))


def measured(rewards: Rewards, origin: float) -> Rewards:
    """
    :param rewards: task rewards, or a mean of them
    :param origin: o
    :return: r - o, exactly 0 where that is rounding (rewards of -0.1 throughout have a mean that is not quite -0.1)
    """
    difference = np.asarray(rewards) - origin
    difference = np.where(np.abs(difference) <= 1e-9 * abs(origin), 0.0, difference)
    return difference if isinstance(rewards, np.ndarray) else float(difference)
