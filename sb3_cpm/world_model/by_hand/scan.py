"""
The RSSM along a sequence, with its gradient by hand (:meth:`sb3_cpm.world_model.rssm.RSSM.observe` says what it computes).

Fifty steps of sixteen columns are so small that what surrounds the products costs more than these. Written by hand, the way
back needs a dozen operations per step instead of fifty: slopes that depend on the forward pass only are computed for all steps
at once, and so are the gradients of all weights, each a single product over all rows. For one step, with the memory h, the
sample z and g_x for the gradient of x::

    a = elu(z W_s + action)                       g_a = (g_y W_g)_a elu'        g_z = g_a W_s
    y = (a, h) W_g;  r, c, u = LayerNorm(y)       g_y = LayerNorm'(slope * g_h')
    h' = h + s(u) (tanh(s(r) c) - h)              g_h = (g_y W_g)_h + (1 - s(u)) g_h'
    p = elu(h' W_d + embedding)                   g_p = g_stats W_o elu';  g_h' += g_p W_d
    stats = p W_o                                 g_stats += the latent's own, of its samples
"""

from typing import Any, NamedTuple

import torch as th
import torch.nn.functional as F
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.distributions import Latent
from sb3_cpm.world_model.fast.activation import tanh_


class Weights(NamedTuple):
    """Of all layers, as ``torch.nn.Linear`` and ``LayerNorm`` hold them. Sizes are those of what is read and given."""

    stoch: th.Tensor  # (hidden, stoch)
    gates: th.Tensor  # (3 * deter, hidden + deter): reset, candidate and update, of a and h
    norm: th.Tensor  # (3 * deter,)
    norm_bias: th.Tensor  # (3 * deter,)
    deter: th.Tensor  # (hidden, deter)
    out: th.Tensor  # (stats, hidden)
    out_bias: th.Tensor  # (stats,)


class ScanSettings(NamedTuple):
    """
    What has no gradient.

    :param latent: kind of the stochastic state
    :param update_bias: of the GRU
    :param norm_eps: of its layer norm
    """

    latent: Latent
    update_bias: float
    norm_eps: float


class Scan(th.autograd.Function):
    """
    ``Scan.apply(settings, noise, is_first, deter, stoch, actions_in, embed_in, *weights)``.

    Takes the latent's noise, ``is_first`` of shape ``(L, n, 1)``, the state before the first row (it gets no gradient),
    projected actions and embeddings of shape ``(L, n, hidden_size)`` with the biases of their layers, and :class:`Weights`.
    Returns deter, stoch and stats of all rows.
    """

    @staticmethod
    def forward(
        ctx: Any,
        settings: ScanSettings,
        noise: th.Tensor,
        is_first: th.Tensor,
        deter: th.Tensor,
        stoch: th.Tensor,
        actions_in: th.Tensor,
        embed_in: th.Tensor,
        *weights: th.Tensor,
    ) -> tuple[th.Tensor, ...]:
        layers, latent = Weights(*weights), settings.latent
        hidden, size = actions_in.shape[-1], deter.shape[-1]
        resets, first = rows_with_resets(is_first), is_first.unbind(0)
        inputs = actions_in.new_empty(*actions_in.shape[:2], hidden + size)  # (L, n, hidden + deter): a and h, side by side
        inner, memory = (part.unbind(0) for part in inputs.split((hidden, size), dim=-1))  # L views: (n, hidden), (n, deter)
        posteriors = th.empty_like(embed_in)  # (L, n, hidden)
        # taking a row of a tensor, or a transpose, costs as much as a small operation: each is taken once
        rows = [part.unbind(0) for part in (actions_in, embed_in, inputs, posteriors, noise)]
        from_stoch, to_gates, from_deter, to_stats = (
            weight.t() for weight in (layers.stoch, layers.gates, layers.deter, layers.out)
        )
        norm_bias = layers.norm_bias.clone()
        norm_bias[2 * size :] += settings.update_bias
        kept: list[tuple[th.Tensor, ...]] = []
        for t, (action_in, embedding, both, posterior, chance) in enumerate(zip(*rows, strict=True)):
            if resets[t]:
                deter, stoch = deter.masked_fill(first[t], 0.0), stoch.masked_fill(first[t], 0.0)
            before = stoch  # (n, stoch)
            F.elu_(th.addmm(action_in, stoch, from_stoch, out=inner[t]))  # a: (n, hidden)
            memory[t].copy_(deter)  # h: (n, deter)
            products = both @ to_gates  # (n, 3 * deter)
            gates, mean, spread = th.native_layer_norm(products, (3 * size,), layers.norm, norm_bias, settings.norm_eps)
            # (n, 3 * deter): reset and update; what becomes of the candidate in between is not looked at
            opened = th.sigmoid(gates)
            bounded = tanh_(opened[:, :size] * gates[:, size : 2 * size])  # (n, deter)
            deter = th.lerp(deter, bounded, opened[:, 2 * size :])  # h': (n, deter)
            F.elu_(th.addmm(embedding, deter, from_deter, out=posterior))  # p: (n, hidden)
            stats = th.addmm(layers.out_bias, posterior, to_stats)  # (n, stats)
            stoch = latent.sample(stats, chance)  # (n, stoch)
            kept.append((deter, stoch, stats, before, products, mean, spread, gates, opened, bounded))
        deters, stochs, all_stats, *rest = (th.stack(part) for part in zip(*kept, strict=True))  # (L, n, ...) each
        ctx.settings, ctx.resets = settings, resets
        ctx.save_for_backward(noise, is_first, deters, all_stats, inputs, posteriors, *rest, *weights)
        return deters, stochs, all_stats

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_deters: th.Tensor, of_stochs: th.Tensor, of_stats: th.Tensor) -> tuple[th.Tensor | None, ...]:
        noise, is_first, deters, all_stats, inputs, posteriors, *rest = ctx.saved_tensors
        befores, products, mean, spread, gates, opened, bounded, *weights = rest
        layers, latent = Weights(*weights), ctx.settings.latent
        size = deters.shape[-1]
        hidden = inputs.shape[-1] - size
        passed = opened[..., :size], gates[..., size : 2 * size], bounded, opened[..., 2 * size :]  # (L, n, deter) each
        slopes_of_gates, remembered = gate_slopes(*passed, inputs[..., hidden:])  # (L, n, 3, deter), (L, n, deter)
        # ELU's slope from its result y: 1 above zero, exp(x) = y + 1 below; (L, n, hidden)
        elu_a, elu_p = inputs[..., :hidden].clamp(max=0.0) + 1.0, posteriors.clamp(max=0.0) + 1.0
        slopes_of_stats = latent.slopes(all_stats, noise)
        norm = (layers.norm, layers.norm_bias)
        g_all_stats, g_all_posteriors, g_all_gates, g_all_products, g_all_a = found = [
            th.empty_like(like) for like in (all_stats, posteriors, products, products, elu_a)
        ]
        rows = [
            part.unbind(0)
            for part in (of_deters, of_stochs, of_stats, slopes_of_stats, elu_p, slopes_of_gates, products, mean, spread)
        ]
        to_stats, to_posteriors, to_gates, to_products, to_a = (part.unbind(0) for part in found)
        first, elus, keeps = is_first.unbind(0), elu_a.unbind(0), remembered.unbind(0)

        # of h' and z, as far as the steps after t made them: (n, deter), (n, stoch)
        g_deter, g_stoch = th.zeros_like(deters[0]), th.zeros_like(of_stochs[0])
        for t, (of_deter, of_stoch, of_stat, slope, elu, slope_of_gates, product, average, deviation) in reversed(
            list(enumerate(zip(*rows, strict=True)))
        ):
            g_stats = th.add(of_stat, latent.pull_back(slope, of_stoch + g_stoch), out=to_stats[t])  # (n, stats)
            g_posterior = th.mm(g_stats, layers.out, out=to_posteriors[t]).mul_(elu)  # (n, hidden)
            g_deter = th.addmm(of_deter + g_deter, g_posterior, layers.deter)  # (n, deter)
            # (n, 3, deter) * (n, 1, deter)
            th.mul(slope_of_gates, g_deter.unsqueeze(1), out=to_gates[t].unflatten(-1, (3, size)))
            g_products = norm_backward(to_gates[t], product, average, deviation, *norm, (True, False, False))[0]
            to_products[t].copy_(g_products)  # (n, 3 * deter)
            g_inner, g_memory = (g_products @ layers.gates).split((hidden, size), dim=-1)  # (n, hidden), (n, deter)
            g_a = th.mul(g_inner, elus[t], out=to_a[t])  # (n, hidden)
            g_deter = g_memory.addcmul_(g_deter, keeps[t])  # of h, which is step t - 1's h': (n, deter)
            g_stoch = g_a @ layers.stoch  # (n, stoch)
            if ctx.resets[t]:
                g_deter.masked_fill_(first[t], 0.0)
                g_stoch.masked_fill_(first[t], 0.0)
        _, g_norm, g_norm_bias = norm_backward(g_all_gates, products, mean, spread, *norm, (False, True, True))
        gradients = Weights(
            rows_weight_gradient(g_all_a, befores),
            rows_weight_gradient(g_all_products, inputs),
            g_norm,
            g_norm_bias,
            rows_weight_gradient(g_all_posteriors, deters),
            rows_weight_gradient(g_all_stats, posteriors),
            g_all_stats.sum((0, 1)),
        )
        return None, None, None, None, None, g_all_a, g_all_posteriors, *gradients


def rows_with_resets(is_first: th.Tensor) -> list[bool]:
    """
    Rows in which any column begins an episode; on a GPU all of them, where looking takes longer than resetting nothing.

    :param is_first: shape ``(L, n, *dims)``, bool
    """
    return [True] * len(is_first) if is_first.is_cuda else is_first.flatten(1).any(dim=1).tolist()


def gate_slopes(
    reset: th.Tensor, candidate: th.Tensor, bounded: th.Tensor, update: th.Tensor, before: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Slopes of a GRU's new memory with respect to its gates (after the layer norm) and to its old memory, of all steps.

    :param reset: the reset gate, after its sigmoid, shape ``(L, n, size)``
    :param candidate: before it is reset
    :param bounded: tanh of the candidate once it is reset
    :param update: the update gate, after its sigmoid
    :param before: memory before the step
    :return: shapes ``(L, n, 3, size)`` and ``(L, n, size)``
    """
    inner = update * (1.0 - bounded.square())
    slopes = (inner * candidate * reset * (1.0 - reset), inner * reset, (bounded - before) * update * (1.0 - update))
    return th.stack(slopes, dim=-2), 1.0 - update


def norm_backward(
    gradient: th.Tensor,
    inputs: th.Tensor,
    mean: th.Tensor,
    spread: th.Tensor,
    gain: th.Tensor,
    bias: th.Tensor,
    wanted: tuple[bool, bool, bool],
) -> tuple[th.Tensor, ...]:
    """Gradients of a layer norm's input, gain and bias."""
    shape = inputs.shape[-1:]
    return th.ops.aten.native_layer_norm_backward(gradient, inputs, shape, mean, spread, gain, bias, list(wanted))


def rows_weight_gradient(gradients: th.Tensor, inputs: th.Tensor) -> th.Tensor:
    """
    Gradient of a layer's weight, over all steps and columns.

    :param gradients: of the layer's output, shape ``(L, n, size_out)``
    :param inputs: shape ``(L, n, size_in)``
    :return: shape ``(size_out, size_in)``
    """
    return gradients.flatten(0, 1).t() @ inputs.flatten(0, 1)
