"""
What an actor does in the world model's imagination, with its gradient by hand (:meth:`ActorCritic.imagine
<sb3_cpm.world_model.behavior.ActorCritic.imagine>` says what it computes), for Gaussian latents on CPUs.

Sixty-four dreams of fifteen steps are so small that what surrounds the products costs as much as these. The way back goes to
the actor's weights only: the dynamics are those of a world model that learns nothing here. As in :mod:`~.scan`, slopes that
depend on the way there only are computed for all steps at once, and so are the gradients of all weights. For one step, with
the memory h, the sample z, the action a, and g_x for the gradient of x::

    o = actor(z, h);  a = sample(o)               g_(z,h) += g_o back through the actor;  g_o = slope g_a + entropy's own
    x = elu(a W_a + z W_s)                        g_(a,z) = g_x elu' (W_a, W_s)
    y = (h, x) W_g;  r, c, u = LayerNorm(y)       g_y = LayerNorm'(slope * g_h')
    h' = h + s(u) (tanh(s(r) c) - h)              g_h = (g_y W_g)_h + (1 - s(u)) g_h';  g_x = (g_y W_g)_x
    p = elu(h' W_p)                               g_p = g_stats W_o elu';  g_h' += g_p W_p
    stats = p W_o;  z' = sample(stats)            g_stats = the latent's own, of g_z'
"""

from typing import Any, NamedTuple

import torch as th
import torch.nn.functional as F
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.by_hand.scan import gate_slopes, norm_backward, rows_weight_gradient
from sb3_cpm.world_model.distributions import GaussianLatent, OutputSampler, TruncatedNormal
from sb3_cpm.world_model.fast.activation import tanh_


class Dynamics(NamedTuple):
    """
    What a step of imagination is made of, none of which learns.

    :param latent: kind of the stochastic state
    :param inputs: weights of the layer before the GRU, for action and stochastic state, shape ``(hidden, action + stoch)``
    :param inputs_bias: of that layer
    :param gates: weights of the GRU, for memory and input, shape ``(3 * deter, deter + hidden)``
    :param norm: gain of its layer norm
    :param norm_bias: bias of its layer norm
    :param norm_eps: of its layer norm
    :param update_bias: of the GRU
    :param prior: weights and biases of the prior's two layers
    """

    latent: GaussianLatent
    inputs: th.Tensor
    inputs_bias: th.Tensor
    gates: th.Tensor
    norm: th.Tensor
    norm_bias: th.Tensor
    norm_eps: float
    update_bias: float
    prior: tuple[tuple[th.Tensor, th.Tensor], tuple[th.Tensor, th.Tensor]]


class DreamSettings(NamedTuple):
    """
    :param horizon: imagined steps, H
    :param through_input: whether the actor's input has a gradient
    """

    horizon: int
    through_input: bool


class Dream(th.autograd.Function):
    """
    ``Dream.apply(settings, dynamics, deter, stoch, *actor)``, where ``actor`` has weight and bias of each of the actor's
    layers, and ``deter`` and ``stoch`` are the states to start in, ``n`` of them, without gradient.

    Returns the latents of the states 0..H-1, those of the states 1..H, each of shape ``(H, n, stoch + deter)``, the actions,
    shape ``(H, n, action_dim)``, and the actor's outputs that they were drawn from, shape ``(H, n, 2 * action_dim)``.
    """

    @staticmethod
    def forward(
        ctx: Any, settings: DreamSettings, dynamics: Dynamics, deter: th.Tensor, stoch: th.Tensor, *actor: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        weights, biases = actor[::2], actor[1::2]
        horizon, n, latent = settings.horizon, len(deter), dynamics.latent
        size, hidden, dim = deter.shape[-1], len(dynamics.inputs), len(weights[-1]) // 2
        # one row per state: (action, stoch, deter, x); what a layer reads lies side by side, and nothing is copied together
        rows = deter.new_empty(horizon + 1, n, dim + latent.size + size + hidden)
        parts = rows.split((dim, latent.size, size, hidden), dim=-1)
        actions, stochs, deters, inner = (part.unbind(0) for part in parts)  # H + 1 views each, of shape (n, size of the part)
        feats = rows[..., dim : dim + latent.size + size]  # (H + 1, n, stoch + deter), what the actor reads
        stochs[0].copy_(stoch)
        deters[0].copy_(deter)
        # taking a row of a tensor, or a transpose, costs as much as a small operation: each is taken once
        seen_rows, to_inner = feats.unbind(0), rows[..., : dim + latent.size].unbind(0)  # to x: (n, action + stoch)
        to_gates = rows[..., dim + latent.size :].unbind(0)  # (n, deter + hidden)
        values = [deter.new_empty(horizon, n, len(weight)) for weight in weights]  # of the actor's layers, its outputs last
        layers = [(bias, weight.t(), value.unbind(0)) for weight, bias, value in zip(weights, biases, values, strict=True)]
        inputs, gates_weight = dynamics.inputs.t(), dynamics.gates.t()
        (to_prior, prior_bias), (to_stats, stats_bias) = ((weight.t(), bias) for weight, bias in dynamics.prior)
        norm_bias = dynamics.norm_bias.clone()
        norm_bias[2 * size :] += dynamics.update_bias
        sampler = OutputSampler(values[-1])
        kept: list[tuple[th.Tensor, ...]] = []  # of every step, for the way back
        for t in range(horizon):
            seen = seen_rows[t]  # (n, stoch + deter)
            for bias, weight, value in layers[:-1]:
                seen = F.elu_(th.addmm(bias, seen, weight, out=value[t]))  # (n, units)
            bias, weight, outputs = layers[-1]
            chance = th.rand_like(actions[t])
            action, standard = sampler.sample(th.addmm(bias, seen, weight, out=outputs[t]), chance)
            actions[t].copy_(action)  # a: (n, action)
            F.elu_(th.addmm(dynamics.inputs_bias, to_inner[t], inputs, out=inner[t]))  # x: (n, hidden)
            products = th.mm(to_gates[t], gates_weight)  # (n, 3 * deter)
            gates, mean, spread = th.native_layer_norm(products, (3 * size,), dynamics.norm, norm_bias, dynamics.norm_eps)
            opened = th.sigmoid(gates)  # reset and update; what becomes of the candidate in between is not looked at
            bounded = tanh_(opened[:, :size] * gates[:, size : 2 * size])  # (n, deter)
            th.lerp(deters[t], bounded, opened[:, 2 * size :], out=deters[t + 1])  # h': (n, deter)
            prior = F.elu_(th.addmm(prior_bias, deters[t + 1], to_prior))  # p: (n, hidden)
            stats = th.addmm(stats_bias, prior, to_stats)  # (n, stats)
            noise = latent.noise(n, like=stats)
            latent.sample(stats, noise, out=stochs[t + 1])  # z': (n, stoch)
            kept.append((chance, standard, products, mean, spread, gates, opened, bounded, prior, stats, noise))
        ctx.settings, ctx.dynamics, ctx.dim = settings, dynamics, dim
        here, there = feats[:-1].contiguous(), feats[1:].contiguous()  # states 0..H-1 and 1..H
        if any(ctx.needs_input_grad):
            ctx.kept = kept
            ctx.save_for_backward(rows, here, *values, *weights)
        return here, there, parts[0][:-1].contiguous(), values[-1]

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_here: th.Tensor, of_there: th.Tensor, of_actions: th.Tensor, of_outputs: th.Tensor
    ) -> tuple[th.Tensor | None, ...]:
        settings, dynamics, dim = ctx.settings, ctx.dynamics, ctx.dim
        rows, here, *rest = ctx.saved_tensors
        values, weights = rest[: len(rest) // 2], rest[len(rest) // 2 :]
        latent, horizon = dynamics.latent, settings.horizon
        hidden, size = len(dynamics.inputs), here.shape[-1] - latent.size
        chance, standard, *_ = stacked = [th.stack(part) for part in zip(*ctx.kept, strict=True)]  # (H, n, ...) each
        gates, opened, bounded, prior, stats, noise = stacked[5:]
        products, mean, spread = (part.unbind(0) for part in stacked[2:5])
        before = rows[:-1, :, dim + latent.size : dim + latent.size + size]  # h: (H, n, deter)
        passed = opened[..., :size], gates[..., size : 2 * size], bounded, opened[..., 2 * size :]
        slopes_of_gates, remembered = (part.unbind(0) for part in gate_slopes(*passed, before))  # (n, 3, deter), (n, deter)
        slopes_of_stats = latent.slopes(stats, noise).unbind(0)
        slopes_of_outputs = TruncatedNormal.of_outputs(values[-1]).slopes(chance, standard).unbind(0)
        hidden_layers = (rows[:-1, :, -hidden:], prior, *values[:-1])
        # ELU's slope from its result y: 1 above zero, exp(x) = y + 1 below
        elu_inner, elu_prior, *elu_values = (one.clamp(max=0.0).add_(1.0).unbind(0) for one in hidden_layers)

        # what comes from outside to the states 1..H: as those in which an action arrives, and in which the next is taken
        outside = of_there.clone()  # row i is state i + 1's
        outside[:-1] += of_here[1:]
        from_outside, from_outputs, from_actions = outside.unbind(0), of_outputs.unbind(0), of_actions.unbind(0)
        to_values = [th.empty_like(one) for one in values]
        *to_hidden, to_outputs = (one.unbind(0) for one in to_values)
        back = list(zip(reversed(weights[1:]), reversed(to_hidden), reversed(elu_values), strict=True))
        (to_prior, _), (to_stats, _) = dynamics.prior
        norm = (dynamics.norm, dynamics.norm_bias, (True, False, False))
        g_stoch, g_deter = outside[-1].split((latent.size, size), dim=-1)  # of state H
        for t in reversed(range(horizon)):  # g_stoch and g_deter are those of state t + 1
            g_stats = latent.pull_back(slopes_of_stats[t], g_stoch)  # (n, stats)
            g_prior = (g_stats @ to_stats).mul_(elu_prior[t])  # (n, hidden)
            g_deter = th.addmm(g_deter, g_prior, to_prior)  # (n, deter)
            g_gates = (slopes_of_gates[t] * g_deter.unsqueeze(1)).flatten(1)  # (n, 3, deter) -> (n, 3 * deter)
            g_products = norm_backward(g_gates, products[t], mean[t], spread[t], *norm)[0]
            g_memory, g_inner = (g_products @ dynamics.gates).split((size, hidden), dim=-1)  # of h and x
            g_action, g_sampled = ((g_inner * elu_inner[t]) @ dynamics.inputs).split((dim, latent.size), dim=-1)  # of a and z
            g_action = g_action + from_actions[t]  # (n, action); its two outputs, mean and spread, both get it
            gradient = th.addcmul(
                from_outputs[t], th.cat((g_action, g_action), dim=-1), slopes_of_outputs[t], out=to_outputs[t]
            )
            for weight, to_layer, elu in back:
                gradient = th.mm(gradient, weight, out=to_layer[t]).mul_(elu[t])  # (n, units)
            if t > 0:  # the state to start in has no gradient
                g_state = from_outside[t - 1]  # state t's, (n, stoch + deter)
                if settings.through_input:
                    g_state = th.addmm(g_state, gradient, weights[0])
                g_stoch, g_remembered = g_state.split((latent.size, size), dim=-1)
                g_stoch = g_stoch + g_sampled
                g_deter = g_memory.addcmul_(g_deter, remembered[t]).add_(g_remembered)
        found: list[th.Tensor] = []
        for to_value, inputs in zip(to_values, [here, *values[:-1]], strict=True):
            found += [rows_weight_gradient(to_value, inputs), to_value.sum((0, 1))]
        return None, None, None, None, *found
