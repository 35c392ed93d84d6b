"""
MLPs and returns of imagination without autograd, in plain float32 on CPUs.

Where a behaviour learns, all gradients have one known way: from the returns to rewards and imagined states, from the critic's
error to its weights. Autograd takes longer to find and follow it than the products of a few hundred imagined states take.
"""

from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.fast.activation import elu_, elu_gradient_
from sb3_cpm.world_model.fast.linear import linear, weight_gradient
from sb3_cpm.world_model.networks import MLP


class Pass(NamedTuple):
    """
    What one pass through an MLP leaves.

    :param output: shape ``(rows, output_dim)``
    :param layers: the dense layers
    :param inputs: of each layer, shape ``(rows, size_in)``
    """

    output: th.Tensor
    layers: list[nn.Linear]
    inputs: list[th.Tensor]

    @th.no_grad()
    def to_inputs(self, gradient: th.Tensor) -> th.Tensor:
        """
        :param gradient: of the output, shape ``(rows, output_dim)``
        :return: that of the first layer's inputs
        """
        for layer, values in zip(reversed(self.layers[1:]), reversed(self.inputs[1:]), strict=True):
            gradient = elu_gradient_(linear(gradient, layer.weight.t()), values)
        return linear(gradient, self.layers[0].weight.t())

    @th.no_grad()
    def to_parameters(self, gradient: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param gradient: of the output, shape ``(rows, output_dim)``
        :return: of each layer's weight and bias
        """
        found: list[th.Tensor] = []
        for layer, values in zip(reversed(self.layers), reversed(self.inputs), strict=True):
            found = [weight_gradient(gradient, values), gradient.sum(0), *found]
            if layer is not self.layers[0]:
                gradient = elu_gradient_(linear(gradient, layer.weight.t()), values)
        return tuple(found)


@th.no_grad()
def through(mlp: MLP, inputs: th.Tensor) -> Pass:
    """
    :param mlp: any, its output layer linear
    :param inputs: shape ``(*batch, input_dim)``
    """
    layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    values = [inputs.reshape(-1, inputs.shape[-1])]
    for layer in layers[:-1]:
        values.append(elu_(linear(values[-1], layer.weight, layer.bias)))
    return Pass(linear(values[-1], layers[-1].weight, layers[-1].bias), layers, values)


class Returns(th.autograd.Function):
    """
    ``Returns.apply(rewards, feats, critic, continue_head, gamma, lambda_)``: the lambda-returns of
    :func:`~sb3_cpm.world_model.losses.lambda_returns` for values and continuation of the states that are arrived in,
    differentiable with respect to rewards and states.

    Takes rewards of shape ``(H, n)``, states of shape ``(H, n, feat_dim)``, and None for a continue head where there is none.
    Returns the returns, and without gradient the values and the discounts, each of shape ``(H, n)``.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rewards: th.Tensor,
        feats: th.Tensor,
        critic: MLP,
        continue_head: MLP | None,
        gamma: float,
        lambda_: float,
    ) -> tuple[th.Tensor, ...]:
        valued = through(critic, feats)  # of H * n rows
        values = valued.output.view_as(rewards)  # (H, n): values[i] is that of state i + 1, in which action i arrives
        ends = None if continue_head is None else through(continue_head, feats)
        goes_on = th.ones_like(rewards) if ends is None else ends.output.view_as(rewards).sigmoid()
        discounts = gamma * goes_on
        returns = th.empty_like(rewards)
        inputs = th.addcmul(rewards, discounts, values, value=1.0 - lambda_).unbind(0)
        decays = (lambda_ * discounts).unbind(0)
        following = values[-1]  # (n,): after the last step the critic has the word
        for i in reversed(range(len(rewards))):
            following = th.addcmul(inputs[i], decays[i], following, out=returns[i])
        ctx.mark_non_differentiable(values, discounts)
        if any(ctx.needs_input_grad):
            ctx.passes, ctx.lambda_, ctx.decays = (valued, ends), lambda_, decays
            ctx.save_for_backward(values, discounts, goes_on, returns)
        return returns, values, discounts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor, *_: th.Tensor) -> tuple[th.Tensor | None, ...]:
        values, discounts, goes_on, returns = ctx.saved_tensors
        valued, ends = ctx.passes
        to_rewards = gradient.clone()  # of return i, also by all that come before it
        rows = to_rewards.unbind(0)
        for i in range(1, len(rows)):
            rows[i].addcmul_(rows[i - 1], ctx.decays[i - 1])
        to_values = to_rewards * discounts * (1.0 - ctx.lambda_)  # (H, n)
        to_values[-1].addcmul_(rows[-1], ctx.decays[-1])
        to_feats = valued.to_inputs(to_values.view(-1, 1))
        if ends is not None:
            following = th.cat((returns[1:], values[-1:]))  # (H, n): the return after each step
            to_logits = to_rewards * th.lerp(values, following, ctx.lambda_) * discounts * (1.0 - goes_on)
            to_feats += ends.to_inputs(to_logits.view(-1, 1))
        return to_rewards, to_feats.view(*values.shape, -1), None, None, None, None
