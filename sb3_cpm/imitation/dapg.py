"""
DAPG, demonstration-augmented policy gradient (Rajeswaran et al. 2018), as a PPO: beside its own loss stands the negative log
likelihood of demonstrated actions, whose weight falls from round to round. Constants as in ManiSkill2 (Gu et al. 2023).
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv

from sb3_cpm.arguments import AT_LEAST_0, SHARE, check, integer
from sb3_cpm.buffers import Demonstration
from sb3_cpm.imitation.callback import demonstrations_for
from sb3_cpm.imitation.cloning import (
    ActionLoss,
    Arrays,
    DemonstratedRows,
    frozen,
    make_rows,
    policy_gradient_parameters,
    read_arrays,
)
from sb3_cpm.imitation.loading import Source


class DAPG(PPO):
    """
    PPO whose every minibatch also makes demonstrated actions likelier, by ``demo_coef * demo_decay ** rounds``; as many
    demonstrated transitions as the minibatch has are drawn for it. With ``demo_coef=0`` and ``critic_warmup=0`` it is PPO, bit
    for bit.

    ::

        model = DAPG("MultiInputPolicy", env, demonstrations="expert", n_episodes=200)

    It starts from a random policy; :class:`~sb3_cpm.imitation.CloneCallback` with ``demonstrations=None`` clones the same
    demonstrations first.

    :param policy: as for PPO
    :param env: as for PPO
    :param demonstrations: see :func:`~sb3_cpm.imitation.load_demonstrations`. Not saved with the model where they are no name
        of a source: give them to ``load(path, env, demonstrations=...)`` again
    :param n_episodes: how many; None: all that there are
    :param hold: whether an expert goes on to the end of the episode
    :param demo_coef: weight of the demonstrations in the first round
    :param demo_decay: what it is multiplied with from round to round
    :param critic_warmup: rounds at first that train the value alone, without the demonstrations
    :param kwargs: further arguments of PPO
    :raises ValueError: for arguments that cannot work; in ``learn()`` for demonstrations that do not fit
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        demonstrations: Source | None = None,
        n_episodes: int | None = None,
        hold: bool = False,
        demo_coef: float = 0.1,
        demo_decay: float = 0.995,
        critic_warmup: int = 4,
        **kwargs: Any,
    ) -> None:
        check("demo_coef", demo_coef, AT_LEAST_0)
        check("demo_decay", demo_decay, SHARE)
        check("critic_warmup", critic_warmup, integer(0))
        self.demonstrations = demonstrations
        self.n_episodes = n_episodes
        self.hold = hold
        self.demo_coef = demo_coef
        self.demo_decay = demo_decay
        self.critic_warmup = critic_warmup
        #: Of training, so far.
        self.rounds = 0
        self._episodes: list[Demonstration] | None = None
        self._arrays: list[Arrays] = []
        self._rows: DemonstratedRows | None = None
        super().__init__(policy, env, **kwargs)

    def demonstration_episodes(self) -> list[Demonstration]:
        """
        :return: the demonstrations; an expert is asked once
        :raises ValueError: if there are none
        """
        if self._episodes is None:
            if self.demonstrations is None:
                raise ValueError(
                    "DAPG learns from demonstrations and was given none: DAPG(policy, env, demonstrations='expert', "
                    "n_episodes=200), or a file or a list; demo_coef=0 does without."
                )
            self._episodes = demonstrations_for(self, self.demonstrations, self.n_episodes, hold=self.hold)
        return self._episodes

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        result = super()._setup_learn(*args, **kwargs)
        if self.demo_coef:
            self._arrays = read_arrays(self, self.demonstration_episodes())
        return result

    def train(self) -> None:
        self.rounds += 1
        warming = self.rounds <= self.critic_warmup
        with frozen(policy_gradient_parameters(self.policy)) if warming else nullcontext():
            weight = 0.0 if warming else self.demo_coef * self.demo_decay ** (self.rounds - 1)
            self.logger.record("train/demo_coef", weight)
            with self._demonstrations_added(weight) if weight else nullcontext():
                super().train()

    @contextmanager
    def _demonstrations_added(self, weight: float) -> Iterator[None]:
        """
        PPO clears the gradients of a minibatch right before it adds those of its loss. In between the demonstrations' are put
        there, so that the sum is clipped and stepped, as if both stood in one loss.
        """
        if self._rows is None or self.get_vec_normalize_env() is not None:  # whose statistics have moved
            self._rows = make_rows(self.policy, self._arrays, self.get_vec_normalize_env())
        optimizer, demonstrated, rows = self.policy.optimizer, ActionLoss(self.policy), self._rows
        clear = optimizer.zero_grad
        losses: list[th.Tensor] = []

        def clear_and_add(set_to_none: bool = True) -> None:
            clear(set_to_none)
            chosen = th.randint(len(rows), (self.batch_size,), device=self.device)
            loss = demonstrated.nll(*rows.batch(chosen))
            (weight * loss).backward()
            losses.append(loss.detach())

        optimizer.zero_grad = clear_and_add  # type: ignore[method-assign]
        try:
            yield
        finally:
            del optimizer.zero_grad
        self.logger.record("train/demo_loss", th.stack(losses).mean().item())

    def _excluded_save_params(self) -> list[str]:
        unsaved = [] if isinstance(self.demonstrations, str) else ["demonstrations"]
        return [*super()._excluded_save_params(), "_episodes", "_arrays", "_rows", *unsaved]
