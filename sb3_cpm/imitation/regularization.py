"""A player that keeps to its demonstrations while it learns from rewards (Nair et al. 2018, Fujimoto and Gu 2021)."""

from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cpm.arguments import ABOVE_0, check, integer, names_checked
from sb3_cpm.buffers import CPMBuffer


class BCLossCallback(BaseCallback):
    """
    After each update of SAC, TQC, TD3 or DDPG one more of its actor, by the squared distance of its actions to those of
    demonstrations in its :class:`~sb3_cpm.buffers.CPMBuffer`.

    Critics have seen the demonstrated actions and no others in the states of demonstrations. What they say of others there is
    noise, and an actor that follows it leaves the demonstrations before its own episodes could show where that leads. Actions
    are drawn as the policy draws them, so that the loss has a say in how random it is, too. The actor's own optimizer makes
    the step, at the rate that it has.

    In a configuration::

        callback:
          - sb3_cpm.imitation.DemonstrationsCallback: {demonstrations: expert, n_episodes: 200}
          - sb3_cpm.imitation.BCLossCallback: {weight: 1.0}

    :param weight: of the loss, a sum over the action's numbers, which are within [-1, 1]
    :param decay_steps: number of environment steps in which the weight falls to 0, linearly; None: it stays
    :param batch_size: demonstrated transitions in a step; None: the model's
    :param verbose: as SB3's callbacks have it
    :raises ValueError: for arguments that cannot work; in ``learn()``, for models without a CPMBuffer
    """

    @names_checked()
    def __init__(
        self, weight: float = 1.0, decay_steps: int | None = None, batch_size: int | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        check("weight", weight, ABOVE_0)
        for name, value in (("decay_steps", decay_steps), ("batch_size", batch_size)):
            if value is not None:
                check(name, value, integer(1))
        self.weight = weight
        self.decay_steps = decay_steps
        self.batch_size = batch_size
        self._seen = 0

    @property
    def current_weight(self) -> float:
        """The weight now."""
        if self.decay_steps is None:
            return self.weight
        return self.weight * max(1.0 - self.model.num_timesteps / self.decay_steps, 0.0)

    def _on_training_start(self) -> None:
        model: Any = self.model
        if not isinstance(getattr(model, "replay_buffer", None), CPMBuffer):
            raise ValueError(
                f"BCLossCallback reads demonstrations from a CPMBuffer, which this {type(model).__name__} has not: make it "
                "with replay_buffer_class=CPMBuffer, replay_buffer_kwargs=dict(challenge_ratio=0, demonstration_ratio=0.5)."
            )
        self._seen = model._n_updates

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._follow()

    def _on_training_end(self) -> None:
        self._follow()

    def _follow(self) -> None:
        """As many steps as the player has made since."""
        model: Any = self.model
        assert isinstance(model, OffPolicyAlgorithm) and isinstance(model.replay_buffer, CPMBuffer)
        due, self._seen = model._n_updates - self._seen, model._n_updates
        weight, buffer = self.current_weight, model.replay_buffer
        if not due or not weight or buffer.demonstrations is None:
            return
        actor: Any = model.policy.actor
        model.policy.set_training_mode(True)
        for _ in range(due):
            batch = buffer.sample_demonstrations(self.batch_size or model.batch_size, env=model.get_vec_normalize_env())
            loss = (drawn_actions(model.policy, batch.observations) - batch.actions).square().sum(1).mean()
            actor.optimizer.zero_grad()
            (weight * loss).backward()
            actor.optimizer.step()
        self.logger.record("train/bc_loss", loss.item())
        self.logger.record("train/bc_weight", weight)


def drawn_actions(policy: BasePolicy, observations: PyTorchObs) -> th.Tensor:
    """
    :param policy: of SAC, TQC, TD3 or DDPG
    :param observations: as its actor takes them
    :return: actions as it draws them, with a gradient, within [-1, 1], shape ``(batch, action_dim)``
    """
    actor: Any = policy.actor
    return actor.action_log_prob(observations)[0] if hasattr(actor, "action_log_prob") else actor(observations)
