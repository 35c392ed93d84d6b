"""
The challenge curator: from a finished trajectory and the challenger's evaluation of it to a challenge, or none.

Lines 9 to 18 of Algorithm 1 in the report: score every transition, choose the goal, filter, relabel. All state that
this needs (six coefficients, three tolerances, reward memory and origin) is here, in plain numbers, and is saved with the
buffer.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sb3_cpm.arguments import ABOVE_0, check, check_arguments, check_each, error_prefix, integer
from sb3_cpm.challenges.filters import CandidateStatistics, ChallengeFilter
from sb3_cpm.challenges.origin import OriginKind, RewardOrigin, measured
from sb3_cpm.challenges.quality import ChallengeQuality, best_goal
from sb3_cpm.challenges.rewards import ArtificialReward, ArtificialRewards
from sb3_cpm.challenges.targeting import DynamicCoefficient
from sb3_cpm.type_aliases import Evaluation


@dataclass(frozen=True)
class Proposal:
    """
    What the curator thought of one trajectory of ``n_steps`` transitions.

    :param rewards: task reward r, shape ``(n_steps,)``
    :param uncertainty: u, shape ``(n_steps,)``
    :param score: S, shape ``(n_steps,)``
    :param disagreement: DISAG, shape ``(n_steps,)``
    :param kl: KL, shape ``(n_steps,)``
    :param first: index of the first counted transition
    :param goal: index g of the goal transition; the goal is the state s_{g+1}
    :param verdicts: for each criterion F1 to F5 by name, whether it would keep the candidate
    :param accepted: whether the challenge was kept
    :param coefficients: the coefficients as used, and the tolerances after this candidate moved them
    :param artificial: rewards of transitions ``first`` to ``goal``, None if the candidate was rejected
    """

    rewards: np.ndarray
    uncertainty: np.ndarray
    score: np.ndarray
    disagreement: np.ndarray
    kl: np.ndarray
    first: int
    goal: int
    verdicts: dict[str, bool]
    accepted: bool
    coefficients: dict[str, float]
    artificial: ArtificialRewards | None


class ChallengeCurator:
    """
    Quality S, filter F and reward R, applied in turn.

    :param warmup_steps: the first transitions of every trajectory that never count, because the latent state starts at
        zero and its surprise is meaningless [B.5.2]
    :param kl_ratio: target of mean(c1 * KL) over mean(DISAG), report: 0.1
    :param reward_ratio: c*, target of mean(c * r) over mean(u), report: 0.75; F1 uses it too
    :param filter_kwargs: passed to :class:`~sb3_cpm.challenges.filters.ChallengeFilter`
    :param reward_kwargs: passed to :class:`~sb3_cpm.challenges.rewards.ArtificialReward`
    :param coefficient_kwargs: passed to every :class:`~sb3_cpm.challenges.targeting.DynamicCoefficient`
    :param reward_origin: see :class:`~sb3_cpm.challenges.origin.RewardOrigin`
    :raises ValueError: for arguments that cannot work, naming the nearest where one is misspelt
    """

    def __init__(
        self,
        warmup_steps: int = 5,
        kl_ratio: float = 0.1,
        reward_ratio: float = 0.75,
        filter_kwargs: dict[str, Any] | None = None,
        reward_kwargs: dict[str, Any] | None = None,
        coefficient_kwargs: dict[str, Any] | None = None,
        reward_origin: OriginKind = "low_quantile",
    ):
        check("warmup_steps", warmup_steps, integer(0))
        check_each(ABOVE_0, kl_ratio=kl_ratio, reward_ratio=reward_ratio)
        check_arguments("filter_kwargs", filter_kwargs, ChallengeFilter, excluded=("reward_ratio",))
        check_arguments("reward_kwargs", reward_kwargs, ArtificialReward, excluded=("coefficient_kwargs",))
        check_arguments("coefficient_kwargs", coefficient_kwargs, DynamicCoefficient, excluded=("target_ratio",))
        self.warmup_steps = warmup_steps
        self.origin = RewardOrigin(reward_origin)
        with error_prefix("coefficient_kwargs"):
            self.quality = ChallengeQuality(kl_ratio, reward_ratio, coefficient_kwargs)
        with error_prefix("filter_kwargs"):
            self.filter = ChallengeFilter(reward_ratio, **(filter_kwargs or {}))
        with error_prefix("reward_kwargs"):
            self.reward = ArtificialReward(coefficient_kwargs=coefficient_kwargs, **(reward_kwargs or {}))

    def propose(self, rewards: np.ndarray, evaluation: Evaluation, remember: bool = True) -> Proposal | None:
        """
        :param rewards: task rewards of a complete trajectory, shape ``(n_steps,)``
        :param evaluation: the challenger's evaluation of the same trajectory
        :param remember: let it count for reward memory and origin
        :return: the proposal, or None if the trajectory has no transition that counts (n_steps <= warmup_steps)
        :raises ValueError: for shapes that don't belong together and values that are not finite; nothing is changed then
        """
        rewards, disagreement, kl, embeddings = _checked(rewards, evaluation)
        first = self.warmup_steps
        if len(rewards) == 0:
            return None
        if remember:
            self.remember(rewards)
        if len(rewards) <= first:
            return None

        uncertainty = self.quality.uncertainty(disagreement, kl, first)
        origin = self.origin.value
        from_origin = measured(rewards, origin)
        score = self.quality.score(from_origin, uncertainty, first)
        goal = best_goal(score, first)
        mean_reward = float(from_origin[first:].mean())
        accepted, verdicts = self.filter.judge(
            CandidateStatistics(
                mean_reward=mean_reward,
                scaled_reward=self.quality.c.value * mean_reward,
                mean_uncertainty=float(uncertainty[first:].mean()),
                mean_score=float(score[first:].mean()),
                goal_score=float(score[goal]),
                goal=goal,
                first=first,
                origin=origin,
            )
        )
        artificial = None
        if accepted:
            kept = slice(first, goal + 1)
            artificial = self.reward(
                rewards[kept],
                uncertainty[kept],
                embeddings[first : goal + 2],
                origin=origin,
                usual_reward=abs(measured(self.filter.reward_memory or 0.0, origin)),
            )
        return Proposal(
            rewards=rewards,
            uncertainty=uncertainty,
            score=score,
            disagreement=disagreement,
            kl=kl,
            first=first,
            goal=goal,
            verdicts=verdicts,
            accepted=accepted,
            coefficients=self.coefficients,
            artificial=artificial,
        )

    def remember(self, rewards: np.ndarray) -> None:
        """
        Let a trajectory count for reward memory and origin.

        :param rewards: task rewards of a complete trajectory, shape ``(n_steps,)``
        """
        rewards = np.asarray(rewards, dtype=np.float64)
        if self.filter.reward_memory_update == "trajectory":
            self.filter.remember(float(rewards.mean()))
        self.origin.remember(rewards)

    def remember_call(self, rewards: Sequence[np.ndarray]) -> None:
        """
        Before trajectories that came together are given to :meth:`propose` or :meth:`remember` in turn: let all of them count
        for the reward memory once, with ``reward_memory_update="call"``.

        :param rewards: task rewards of each, shape ``(n_steps,)``
        """
        if self.filter.reward_memory_update == "call" and rewards:
            self.filter.remember(float(np.concatenate(rewards).mean(dtype=np.float64)))

    def refresh(self, proposal: Proposal, evaluation: Evaluation) -> Proposal:
        """
        The rewards of a challenge that was kept, with a newer evaluation of its trajectory. Where it starts and ends stays,
        and so do coefficients, tolerances, reward memory and origin: nothing new has happened.

        :param proposal: an accepted one
        :param evaluation: of the whole trajectory
        :return: the same with today's uncertainty, score and artificial rewards
        :raises ValueError: as :meth:`propose`
        """
        rewards, disagreement, kl, embeddings = _checked(proposal.rewards, evaluation)
        uncertainty = self.quality.c1.value * kl + disagreement
        origin = self.origin.value
        kept = slice(proposal.first, proposal.goal + 1)
        return replace(
            proposal,
            uncertainty=uncertainty,
            score=self.quality.c.value * measured(rewards, origin) + uncertainty,
            disagreement=disagreement,
            kl=kl,
            coefficients=self.coefficients,
            artificial=self.reward(
                rewards[kept], uncertainty[kept], embeddings[proposal.first : proposal.goal + 2], adapt=False, origin=origin
            ),
        )

    @property
    def coefficients(self) -> dict[str, float]:
        """All dynamic quantities by the report's names, as they are now; no reward memory yet is nan."""
        memory = self.filter.reward_memory
        return {
            "c": self.quality.c.value,
            "c1": self.quality.c1.value,
            "c_expl": self.reward.c_expl.value,
            "c_emb": self.reward.c_emb.value,
            "c_step": self.reward.c_step.value,
            "w1": self.filter.w1.value,
            "w2": self.filter.w2.value,
            "w3": self.filter.w3.value,
            "reward_memory": float("nan") if memory is None else memory,
            "reward_origin": self.origin.value,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if "origin" not in state:  # saved before rewards had one: today's defaults, as for a run that begins now
            defaults = ChallengeCurator()
            self.origin = defaults.origin
            reward, quality = self.reward, self.quality
            for coefficient in (quality.c, quality.c1, reward.c_expl, reward.c_emb, reward.c_step):
                _complete(coefficient, defaults.quality.c)
            _complete(reward, defaults.reward)
            _complete(self.filter, defaults.filter)


def _complete(part: Any, default: Any) -> None:
    """Give it the attributes that only the default has."""
    vars(part).update({name: value for name, value in vars(default).items() if name not in vars(part)})


def _checked(rewards: np.ndarray, evaluation: Evaluation) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Everything as float64 arrays of the right shapes, or a ValueError that says which one is wrong."""
    rewards, disagreement, kl, embeddings = (
        np.asarray(array, dtype=np.float64)
        for array in (rewards, evaluation.disagreement, evaluation.kl, evaluation.embeddings)
    )
    n_steps = len(rewards)
    for name, array, rows, ndim in (
        ("rewards", rewards, n_steps, 1),
        ("disagreement", disagreement, n_steps, 1),
        ("kl", kl, n_steps, 1),
        ("embeddings", embeddings, n_steps + 1, 2),
    ):
        if array.ndim != ndim or len(array) != rows:
            wanted = f"({rows},)" if ndim == 1 else f"({rows}, embed_dim)"
            raise ValueError(f"Evaluation of a {n_steps}-step trajectory: {name} has shape {array.shape}, expected {wanted}")
        if not np.isfinite(array).all():
            raise ValueError(f"Evaluation of a {n_steps}-step trajectory: {name} holds NaN or infinite values")
    return rewards, disagreement, kl, embeddings
