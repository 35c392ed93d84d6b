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

import torch
import torch.nn.functional as F
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.distributions import Latent


class Weights(NamedTuple):
    """Of all layers, as ``torch.nn.Linear`` and ``LayerNorm`` hold them."""

    stoch: torch.Tensor
    gates: torch.Tensor
    norm: torch.Tensor
    norm_bias: torch.Tensor
    deter: torch.Tensor
    out: torch.Tensor
    out_bias: torch.Tensor


class Settings(NamedTuple):
    """
    What has no gradient.

    :param latent: kind of the stochastic state
    :param update_bias: of the GRU
    :param norm_eps: of its layer norm
    """

    latent: Latent
    update_bias: float
    norm_eps: float


class Scan(torch.autograd.Function):
    """
    ``Scan.apply(settings, noise, is_first, deter, stoch, actions_in, embed_in, *weights)``.

    Takes the latent's noise, ``is_first`` of shape ``(L, n, 1)``, the state before the first row (it gets no gradient),
    projected actions and embeddings of shape ``(L, n, hidden_size)`` with the biases of their layers, and :class:`Weights`.
    Returns deter, stoch and stats of all rows.
    """

    @staticmethod
    def forward(
        ctx: Any,
        settings: Settings,
        noise: torch.Tensor,
        is_first: torch.Tensor,
        deter: torch.Tensor,
        stoch: torch.Tensor,
        actions_in: torch.Tensor,
        embed_in: torch.Tensor,
        *weights: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        layers, latent = Weights(*weights), settings.latent
        hidden, size = actions_in.shape[-1], deter.shape[-1]
        resets = rows_with_resets(is_first)
        inputs = actions_in.new_empty(*actions_in.shape[:2], hidden + size)  # of the gates: a and h, side by side
        rows: list[tuple[torch.Tensor, ...]] = []
        for t, reset in enumerate(resets):
            if reset:
                deter, stoch = deter.masked_fill(is_first[t], 0.0), stoch.masked_fill(is_first[t], 0.0)
            inputs[t, :, :hidden] = F.elu_(torch.addmm(actions_in[t], stoch, layers.stoch.t()))
            inputs[t, :, hidden:] = deter
            products = inputs[t] @ layers.gates.t()
            gates, mean, spread = torch.native_layer_norm(
                products, (3 * size,), layers.norm, layers.norm_bias, settings.norm_eps
            )
            before, (reset_gate, candidate, update) = stoch, gates.chunk(3, dim=-1)
            candidate = torch.tanh(torch.sigmoid(reset_gate) * candidate)
            deter = torch.lerp(deter, candidate, torch.sigmoid(update + settings.update_bias))
            posterior = F.elu_(torch.addmm(embed_in[t], deter, layers.deter.t()))
            stats = torch.addmm(layers.out_bias, posterior, layers.out.t())
            stoch = latent.sample(stats, noise[t])
            rows.append((deter, stoch, stats, before, products, gates, mean, spread, posterior))
        deters, stochs, all_stats, *rest = (torch.stack(part) for part in zip(*rows, strict=True))
        ctx.settings, ctx.resets = settings, resets
        ctx.save_for_backward(noise, is_first, deters, all_stats, inputs, *rest, *weights)
        return deters, stochs, all_stats

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_deters: torch.Tensor, of_stochs: torch.Tensor, of_stats: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        noise, is_first, deters, stats, inputs, befores, products, gates, mean, spread, posteriors, *rest = ctx.saved_tensors
        layers, latent = Weights(*rest), ctx.settings.latent
        size = deters.shape[-1]
        hidden = inputs.shape[-1] - size
        latent_slopes = latent.slopes(stats, noise)
        elu_a, elu_p = inputs[..., :hidden].clamp(max=0.0) + 1.0, posteriors.clamp(max=0.0) + 1.0
        gate_slopes, kept = _gate_slopes(gates, inputs[..., hidden:], ctx.settings.update_bias)

        carry_deter, carry_stoch = torch.zeros_like(deters[0]), torch.zeros_like(of_stochs[0])
        found: list[tuple[torch.Tensor, ...]] = []
        for t in reversed(range(len(deters))):
            g_stats = of_stats[t] + latent.pull_back(latent_slopes[t], of_stochs[t] + carry_stoch)
            g_posterior = (g_stats @ layers.out).mul_(elu_p[t])
            g_deter = torch.addmm(of_deters[t] + carry_deter, g_posterior, layers.deter)
            g_gates = (gate_slopes[t] * g_deter.unsqueeze(1)).flatten(1)
            g_products = _norm_backward(g_gates, products[t], mean[t], spread[t], layers, (True, False, False))[0]
            g_inputs = g_products @ layers.gates
            g_a = g_inputs[:, :hidden] * elu_a[t]
            carry_deter = torch.addcmul(g_inputs[:, hidden:], g_deter, kept[t])
            carry_stoch = g_a @ layers.stoch
            if ctx.resets[t]:
                carry_deter.masked_fill_(is_first[t], 0.0)
                carry_stoch.masked_fill_(is_first[t], 0.0)
            found.append((g_stats, g_posterior, g_gates, g_products, g_a))
        all_stats, all_posteriors, all_gates, all_products, all_a = (
            torch.stack(part) for part in zip(*reversed(found), strict=True)
        )
        _, g_norm, g_norm_bias = _norm_backward(all_gates, products, mean, spread, layers, (False, True, True))
        gradients = Weights(
            _weight_gradient(all_a, befores),
            _weight_gradient(all_products, inputs),
            g_norm,
            g_norm_bias,
            _weight_gradient(all_posteriors, deters),
            _weight_gradient(all_stats, posteriors),
            all_stats.sum((0, 1)),
        )
        return None, None, None, None, None, all_a, all_posteriors, *gradients


def rows_with_resets(is_first: torch.Tensor) -> list[bool]:
    """
    Rows in which any column begins an episode; on a GPU all of them, where looking takes longer than resetting nothing.

    :param is_first: shape ``(L, n, *dims)``, bool
    """
    return [True] * len(is_first) if is_first.is_cuda else is_first.flatten(1).any(dim=1).tolist()


def _gate_slopes(gates: torch.Tensor, before: torch.Tensor, update_bias: float) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Slopes of the new memory with respect to the gates and to the old memory, of all steps.

    :param gates: after the layer norm, shape ``(L, n, 3 * size)``
    :param before: memory before the step, shape ``(L, n, size)``
    :return: shapes ``(L, n, 3, size)`` and ``(L, n, size)``
    """
    reset, candidate, update = gates.chunk(3, dim=-1)
    reset, update = torch.sigmoid(reset), torch.sigmoid(update + update_bias)
    bounded = torch.tanh(reset * candidate)
    inner = update * (1.0 - bounded.square())
    slopes = (inner * candidate * reset * (1.0 - reset), inner * reset, (bounded - before) * update * (1.0 - update))
    return torch.stack(slopes, dim=-2), 1.0 - update


def _norm_backward(
    gradient: torch.Tensor,
    inputs: torch.Tensor,
    mean: torch.Tensor,
    spread: torch.Tensor,
    layers: Weights,
    wanted: tuple[bool, bool, bool],
) -> tuple[torch.Tensor, ...]:
    """Gradients of a layer norm's input, gain and bias."""
    shape = inputs.shape[-1:]
    return torch.ops.aten.native_layer_norm_backward(
        gradient, inputs, shape, mean, spread, layers.norm, layers.norm_bias, list(wanted)
    )


def _weight_gradient(gradients: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
    """Of a layer's weight, over all rows."""
    return gradients.flatten(0, 1).t() @ inputs.flatten(0, 1)
