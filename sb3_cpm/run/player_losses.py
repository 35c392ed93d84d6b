"""
What the player's losses and values are on D and on I (Figure 11): batches of either kind, rated by the networks as they are.

Nothing is trained, no random state is touched and nothing is counted, so that a run with this diagnosis is the same as one
without, and logs the same beside it.
"""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from torch.nn import functional

from sb3_cpm.buffers import CPMBuffer

BATCH_SIZE = 256


def log_player_losses(model: BaseAlgorithm) -> None:
    """
    Log ``player/q_D``, ``player/critic_loss_D``, ``player/actor_loss_D``, and the same on I, where there are both.

    :param model: nothing happens unless it is a SAC with a :class:`CPMBuffer` that holds challenges
    """
    buffer = getattr(model, "replay_buffer", None)
    if not (isinstance(model, SAC) and isinstance(buffer, CPMBuffer) and buffer.challenges):
        return
    ratios, imaginary = (buffer.challenge_ratio, buffer.demonstration_ratio), buffer._imaginary
    with _unnoticed():
        try:
            buffer._imaginary = copy.copy(imaginary)  # it counts the ages of what is sampled, which the run logs as P's
            for name, share in (("D", 0.0), ("I", 1.0)):
                buffer.challenge_ratio, buffer.demonstration_ratio = share, 0.0
                batch = buffer.sample(BATCH_SIZE, env=model.get_vec_normalize_env())
                for kind, value in player_losses(model, batch).items():
                    model.logger.record(f"player/{kind}_{name}", value)
        finally:
            buffer.challenge_ratio, buffer.demonstration_ratio = ratios
            buffer._imaginary = imaginary


def player_losses(model: SAC, batch: DictReplayBufferSamples) -> dict[str, float]:
    """
    :param model: the player
    :param batch: transitions
    :return: mean Q value of the actions taken, critic loss, actor loss: as ``SAC.train`` has them
    """
    with th.no_grad():
        coefficient = model.ent_coef_tensor if model.log_ent_coef is None else model.log_ent_coef.exp()
        next_actions, next_log_prob = model.actor.action_log_prob(batch.next_observations)
        next_values = th.cat(model.critic_target(batch.next_observations, next_actions), dim=1).min(dim=1, keepdim=True).values
        next_values = next_values - coefficient * next_log_prob.reshape(-1, 1)
        target = batch.rewards + (1 - batch.dones) * model.gamma * next_values
        values = model.critic(batch.observations, batch.actions)
        actions, log_prob = model.actor.action_log_prob(batch.observations)
        of_policy = th.cat(model.critic(batch.observations, actions), dim=1).min(dim=1, keepdim=True).values
        return {
            "q": float(th.cat(values, dim=1).mean()),
            "critic_loss": float(0.5 * sum(functional.mse_loss(one, target) for one in values)),
            "actor_loss": float((coefficient * log_prob.reshape(-1, 1) - of_policy).mean()),
        }


@contextmanager
def _unnoticed() -> Iterator[None]:
    """Random states are put back."""
    numpy_state = np.random.get_state()
    with th.random.fork_rng(enabled=True):
        try:
            yield
        finally:
            np.random.set_state(numpy_state)
