"""
Progress-sensitive artificial rewards: what the player gets for the transitions of a challenge.

Report, section 4.4.3 and appendix B.6: task reward, uncertainty, progress toward the goal in the embedding space, and
progress in steps, halved so that the sum is about as large as the task reward that it replaces.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sb3_cpm.arguments import ABOVE_0, Rule, check, check_each, choice
from sb3_cpm.challenges.origin import measured
from sb3_cpm.challenges.targeting import DynamicCoefficient

#: The terms of an artificial reward, attributes of :class:`ArtificialRewards`.
REWARD_TERMS = ("extrinsic", "exploration", "embedding", "step")


@dataclass(frozen=True)
class ArtificialRewards:
    """
    The rewards r' of one challenge, and the terms that they consist of, each times its coefficient, before halving.

    All arrays have the shape ``(length of the challenge,)``;
    ``total = scale * (extrinsic + exploration + embedding + step) + constant``.
    """

    total: np.ndarray
    extrinsic: np.ndarray
    exploration: np.ndarray
    embedding: np.ndarray
    step: np.ndarray
    constant: float = 0.0


class ArtificialReward:
    """
    r' = 0.5 * (r + c_expl * u + c_emb * d_emb + c_step * d_step), with the coefficients following their targets.

    Once they have settled on positive terms, mean(r') = 0.5 * (1 + 2/3 + 0.2 + 0.2) * mean(r) = 1.03 * mean(r), "a similar
    range" [B.6]. Beyond the report, where rewards are not positive:

    * Negative rewards would be cancelled by the other terms, which are as large and positive. A challenge that holds some, or
      whose rewards are measured from a negative origin, gets the constant b with mean(r') = mean(r). (1.03 * mean(r) would be
      lower than mean(r) instead of higher, and of rewards around -1000 it would move more than they differ.)
    * A challenge that no reward tells from the origin has no size to compare with. That of the reward memory stands in, before
      any reward ``zero_reward_size``. With the latter mean(r') = 0.5 * (2/3 + 0.2 + 0.2) * 0.1 = 0.05.

    :param exploration_ratio: target of mean(c_expl * u) over mean(r), report: 1 / 1.5
    :param embedding_ratio: target of mean(c_emb * d_emb) over mean(c_expl * u), report: 0.3
    :param step_ratio: target of mean(c_step * d_step) over mean(c_expl * u), report: 0.3
    :param scale: factor of the whole sum, report: 0.5
    :param distance_reference: what the two terms of progress are compared with: ``"exploration"``, c_expl * u, whose size is
        that of the task reward; ``"uncertainty"``, u itself, as printed in the report: c_emb and c_step then follow the
        peaks of u (its Figure 8), and the size of r' does, too
    :param keep_mean: add that constant; False: r' as it is printed
    :param zero_reward_size: mean reward that the terms of a challenge without reward are sized for before there has been
        any. 0.1 is about that of ManiSkill's normalized dense rewards, and a tenth of a sparse reward of 1, which is not to be
        drowned once it is found. None: such challenges leave c_expl where it is, in the beginning at 1 whatever the size of u
    :param coefficient_kwargs: passed to each :class:`~sb3_cpm.challenges.targeting.DynamicCoefficient`
    :raises ValueError: for a ratio, scale or size that is no finite number above 0
    """

    def __init__(
        self,
        exploration_ratio: float = 1 / 1.5,
        embedding_ratio: float = 0.3,
        step_ratio: float = 0.3,
        scale: float = 0.5,
        distance_reference: Literal["exploration", "uncertainty"] = "exploration",
        keep_mean: bool = True,
        zero_reward_size: float | None = 0.1,
        coefficient_kwargs: dict[str, Any] | None = None,
    ):
        check_each(
            ABOVE_0, exploration_ratio=exploration_ratio, embedding_ratio=embedding_ratio, step_ratio=step_ratio, scale=scale
        )
        check("distance_reference", distance_reference, choice("exploration", "uncertainty"))
        check("keep_mean", keep_mean, choice(True, False))
        optional = Rule(f"None or {ABOVE_0.words}", lambda value: value is None or ABOVE_0.holds(value))
        check("zero_reward_size", zero_reward_size, optional)
        kwargs = coefficient_kwargs or {}
        self.scale = scale
        self.distance_reference = distance_reference
        self.keep_mean = keep_mean
        self.zero_reward_size = zero_reward_size
        self.c_expl = DynamicCoefficient(exploration_ratio, **kwargs)
        self.c_emb = DynamicCoefficient(embedding_ratio, **kwargs)
        self.c_step = DynamicCoefficient(step_ratio, **kwargs)

    def __call__(
        self,
        rewards: np.ndarray,
        uncertainty: np.ndarray,
        embeddings: np.ndarray,
        adapt: bool = True,
        origin: float = 0.0,
        usual_reward: float = 0.0,
    ) -> ArtificialRewards:
        """
        Relabel the transitions of a challenge of ``n`` steps.

        :param rewards: task rewards r, shape ``(n,)``
        :param uncertainty: u, shape ``(n,)``
        :param embeddings: e of every state from the challenge's start to its goal, shape ``(n + 1, embed_dim)``
        :param adapt: let the coefficients follow their targets
        :param origin: o, where rewards are measured from, see :class:`~sb3_cpm.challenges.origin.RewardOrigin`
        :param usual_reward: size of the reward memory measured from there, 0 before any reward
        :return: artificial rewards and their terms
        """
        d_emb, d_step = embedding_progress(embeddings), step_progress(len(rewards))
        if adapt:
            size, provisional = self._reference(measured(rewards, origin), usual_reward)
            self.c_expl.update(uncertainty, size, provisional)
        exploration = self.c_expl.value * uncertainty
        if adapt:
            reference = uncertainty if self.distance_reference == "uncertainty" else exploration
            self.c_emb.update(d_emb, reference, provisional)
            self.c_step.update(d_step, reference, provisional)
        embedding, step = self.c_emb.value * d_emb, self.c_step.value * d_step
        total = self.scale * (rewards + exploration + embedding + step)
        constant = 0.0
        if self.keep_mean and (origin < 0 or bool((rewards < 0).any())):
            constant = float(rewards.mean() - total.mean())
        return ArtificialRewards(total + constant, rewards, exploration, embedding, step, constant)

    def _reference(self, rewards: np.ndarray, usual_reward: float) -> tuple[np.ndarray, bool]:
        """:return: what the exploration term is compared with, and whether it only stands in for rewards still to come"""
        if rewards.any() or self.zero_reward_size is None:
            return rewards, False
        return np.array([usual_reward or self.zero_reward_size]), True


def embedding_progress(embeddings: np.ndarray) -> np.ndarray:
    """
    d_emb: by how much each step comes closer to the last state, in the L1 norm. It sums to the distance of the first
    state to the last.

    :param embeddings: shape ``(n + 1, embed_dim)``, the last row being the goal's
    :return: shape ``(n,)``
    """
    distance = np.abs(embeddings - embeddings[-1]).sum(axis=-1, dtype=np.float64)
    return distance[:-1] - distance[1:]


def step_progress(n_steps: int) -> np.ndarray:
    """
    d_step: position within the challenge over its length; the goal's transition gets 1.

    :param n_steps: length of the challenge
    :return: shape ``(n_steps,)``
    """
    return np.arange(1, n_steps + 1) / n_steps
