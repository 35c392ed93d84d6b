"""The losses of Dreamer as pure functions (Hafner et al. 2021, eq. 2, 4 and 5)."""

from typing import Any

import torch as th
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.distributions import Latent
from sb3_cpm.world_model.fast.acceleration import cache_slices


def masked_mean(values: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """
    Mean over the entries where ``mask`` is True; 0 where there are none.

    What stands in the padding has no influence, not even NaN.

    :param values: shape ``(*batch,)``
    :param mask: shape ``(*batch,)``, bool
    """
    return values.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)


def squared_error(prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    Negative log-likelihood of a unit-variance Gaussian without its constant, summed over all but the first dimension.

    :param prediction: shape ``(n, *dims)``
    :param target: shape ``(n, *dims)``, without gradient
    """
    return _SquaredError.apply(prediction, target)


class _SquaredError(th.autograd.Function):
    """:func:`squared_error` by hand: images are read and written in slices that fit into the cache, not once per operation."""

    @staticmethod
    def forward(ctx: Any, prediction: th.Tensor, target: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(prediction, target)
        dims = tuple(range(1, prediction.dim()))
        squares = [(one - other).square_() for one, other in cache_slices(prediction, target)]
        return 0.5 * th.cat([one.sum(dims) if dims else one for one in squares])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:
        prediction, target = ctx.saved_tensors
        result = th.empty_like(prediction)
        factors = gradient.reshape(-1, *[1] * (prediction.dim() - 1))
        for out, one, other, factor in cache_slices(result, prediction, target, factors):
            th.sub(one, other, out=out).mul_(factor)
        return result, None


def balanced_kl(
    latent: Latent, posterior: th.Tensor, prior: th.Tensor, mask: th.Tensor, balance: float, free_nats: float
) -> tuple[th.Tensor, th.Tensor]:
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


def lambda_returns(rewards: th.Tensor, values: th.Tensor, discounts: th.Tensor, lambda_: float) -> th.Tensor:
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
    return th.stack(returns[::-1])
