"""The losses of Dreamer as pure functions (Hafner et al. 2021, eq. 2, 4 and 5)."""

import torch
import torch.nn.functional as F

from sb3_cpm.world_model.distributions import Latent


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """
    Mean over the entries where ``mask`` is True; 0 where there are none.

    What stands in the padding has no influence, not even NaN.

    :param values: shape ``(*batch,)``
    :param mask: shape ``(*batch,)``, bool
    """
    return values.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)


def squared_error(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of a unit-variance Gaussian without its constant, summed over all but the first dimension."""
    error = F.mse_loss(prediction, target, reduction="none")  # one pass over the images, forwards and backwards
    return 0.5 * (error.sum(tuple(range(1, error.dim()))) if error.dim() > 1 else error)


def balanced_kl(
    latent: Latent, posterior: torch.Tensor, prior: torch.Tensor, mask: torch.Tensor, balance: float, free_nats: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    KL loss that moves the prior towards the posterior faster than the other way round (DreamerV2, algorithm 2).

    Free nats apply to the batch mean of either side: below them its gradient is zero.

    :param latent: kind of the stochastic state
    :param posterior: parameters, shape ``(*batch, stats_size)``
    :param prior: parameters, shape ``(*batch, stats_size)``
    :param mask: rows that count, shape ``(*batch,)``
    :param balance: share of the prior's side, 0.8 in DreamerV2
    :param free_nats: nats that cost nothing
    :return: the loss, and the KL's mean as it is, without gradient
    """
    prior_side, posterior_side = (masked_mean(side, mask) for side in latent.kl_sides(posterior, prior))
    loss = balance * prior_side.clamp(min=free_nats) + (1.0 - balance) * posterior_side.clamp(min=free_nats)
    return loss, prior_side.detach()


def lambda_returns(rewards: torch.Tensor, values: torch.Tensor, discounts: torch.Tensor, lambda_: float) -> torch.Tensor:
    """
    TD(lambda) targets: G_i = r_i + d_i * ((1 - lambda) * v_i + lambda * G_{i+1}), with the last v instead of G behind the end.

    Index i belongs to transition i: ``rewards[i]``, ``values[i]`` and ``discounts[i]`` are those of the state it *arrives* in.

    :param rewards: shape ``(H, n)``
    :param values: shape ``(H, n)``
    :param discounts: gamma times the probability that the episode goes on, shape ``(H, n)``
    :param lambda_: 0 gives one-step targets, 1 the discounted sum
    :return: shape ``(H, n)``
    """
    inputs = rewards + discounts * values * (1.0 - lambda_)
    carry = values[-1]
    returns = []
    for i in reversed(range(len(rewards))):
        carry = inputs[i] + lambda_ * discounts[i] * carry
        returns.append(carry)
    return torch.stack(returns[::-1])
