"""K networks computed as one, and how much they disagree (Lakshminarayanan et al. 2017; Pathak et al. 2019, eq. 1)."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cpm.uncertainty.scale import EPSILON, root
from sb3_cpm.world_model.acceleration import cache_slices, is_plain
from sb3_cpm.world_model.activation import elu_, elu_gradient_
from sb3_cpm.world_model.linear import add_product_, affine, is_large, multiply
from sb3_cpm.world_model.losses import squared_error
from sb3_cpm.world_model.one_hot import Choice, OneHot, find_choice


class Ensemble(nn.Module):
    """
    K MLPs with ELU and linear outputs, computed as one: every layer is a single batched matrix product (on CPUs one per head).

    :param heads: K
    :param input_dim: size of the input
    :param output_dim: size of the output
    :param layers: hidden layers
    :param units: size of each of them
    :param one_hot: which inputs are one-hot vectors
    :raises ValueError: for fewer than two heads
    """

    def __init__(
        self, heads: int, input_dim: int, output_dim: int, layers: int, units: int, one_hot: OneHot | None = None
    ) -> None:
        super().__init__()
        if heads < 2:
            raise ValueError(f"Disagreement needs at least two `heads`, got {heads}.")
        sizes = [input_dim, *[units] * layers, output_dim]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for size_in, size_out in pairwise(sizes):
            bound = math.sqrt(6.0 / (size_in + size_out))  # Glorot, for each head on its own
            self.weights.append(nn.Parameter(torch.empty(heads, size_in, size_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.zeros(heads, 1, size_out)))
        self.heads, self.one_hot = heads, one_hot

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """
        :param inputs: shape ``(n, input_dim)``
        :return: shape ``(heads, n, output_dim)``
        """
        hidden = inputs.expand(self.heads, *inputs.shape)
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if layer < last:
                hidden = elu_(hidden)
        return hidden

    def predictions(self, inputs: torch.Tensor) -> Sequence[torch.Tensor]:
        """The same as a sequence of the heads' outputs, each of shape ``(n, output_dim)``, without copying them together."""
        return self._one_by_one(inputs) if is_large(inputs, self.biases[0].shape[-1]) else self(inputs).unbind(0)

    def _one_by_one(self, inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """On CPUs: a head's layers fit into the cache."""
        choice = find_choice(inputs, self.one_hot, self.biases[0].shape[-1])  # one for all heads
        return _Heads.apply(inputs, choice, *self.weights, *self.biases)


class _Heads(torch.autograd.Function):
    """
    One head after the other, with gradients by hand: all heads' weights are one parameter, whose gradient is written head by
    head. Composed of PyTorch's operations it would be copied together, and those for the inputs added up one by one.
    """

    @staticmethod
    def forward(ctx: Any, inputs: torch.Tensor, choice: Choice | None, *parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        layers = len(parameters) // 2
        weights, biases = parameters[:layers], parameters[layers:]
        hidden, outputs = [], []
        for head in range(len(weights[0])):
            output = inputs
            for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
                if layer == 0 and choice is not None:
                    output = choice.affine(inputs, weight[head], bias[head, 0])
                else:
                    output = affine(output, weight[head], bias[head, 0])
                if layer < layers - 1:
                    hidden.append(elu_(output))
            outputs.append(output)
        ctx.choice = choice
        ctx.save_for_backward(inputs, *weights, *hidden)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        inputs_learn, _, weights_learn, *others = ctx.needs_input_grad
        layers = (1 + len(others)) // 2
        inputs, *saved = ctx.saved_tensors
        weights, hidden = saved[:layers], saved[layers:]
        to_inputs = torch.zeros_like(inputs) if inputs_learn else None
        to_weights = [torch.empty_like(weight) if weights_learn else None for weight in weights]
        to_biases = [weight.new_empty(len(weight), 1, weight.shape[-1]) if weights_learn else None for weight in weights]
        for head, gradient in enumerate(gradients):
            gradient = gradient.contiguous()  # the gradient of a sum has no strides
            values = [inputs, *hidden[head * (layers - 1) : (head + 1) * (layers - 1)]]
            for layer in reversed(range(layers)):
                to_weight, to_bias = to_weights[layer], to_biases[layer]
                if to_weight is not None and to_bias is not None:
                    torch.sum(gradient, 0, out=to_bias[head, 0])
                    if layer == 0 and ctx.choice is not None:
                        ctx.choice.write_gradient(inputs, gradient, to_weight[head])
                    else:
                        multiply(values[layer].t(), gradient.t(), out=to_weight[head])
                if layer > 0:
                    gradient = elu_gradient_(multiply(gradient, weights[layer][head]), values[layer])
                elif to_inputs is not None:
                    add_product_(to_inputs, gradient, weights[0][head])
        return to_inputs, None, *to_weights, *to_biases


def disagreement(predictions: Sequence[torch.Tensor] | torch.Tensor) -> torch.Tensor:
    """
    Standard deviation over the heads, averaged over the dimensions.

    :param predictions: of each head, shape ``(*batch, dim)``
    :return: shape ``(*batch,)``, at least 0
    """
    return _Disagreement.apply(*predictions)


class _Disagreement(torch.autograd.Function):
    """
    :func:`disagreement`, with its gradient by hand: d/dp_k of the standard deviation s is (p_k - mean) / (K * s).

    Imagination rates 12000 states at once, so the predictions are larger than any cache. A slice of rows after the other is
    read from memory once; composed of PyTorch's operations, each of ten would read and write them all.
    """

    @staticmethod
    def forward(ctx: Any, *predictions: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(*predictions)
        dim = predictions[0].shape[-1]
        slices = cache_slices(*(one.view(-1, dim) for one in predictions))
        result = torch.cat([root(_spread(parts)[1]).mean(-1) for parts in slices])
        return result.view(predictions[0].shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, ...]:
        predictions = ctx.saved_tensors
        dim = predictions[0].shape[-1]
        results = [torch.empty_like(one) for one in predictions]
        scale = gradient.reshape(-1, 1) / (len(predictions) * dim)
        for weight, *parts in cache_slices(scale, *(one.view(-1, dim) for one in (*predictions, *results))):
            differences, variance = _spread(parts[: len(predictions)])
            slope = weight / (variance + EPSILON**2).sqrt_()
            for difference, out in zip(differences, parts[len(predictions) :], strict=True):
                torch.mul(difference, slope, out=out)
        return tuple(results)


def _spread(predictions: Sequence[torch.Tensor]) -> tuple[list[torch.Tensor], torch.Tensor]:
    """The heads' differences from their mean, and the variance."""
    mean = predictions[0] + predictions[1]
    for one in predictions[2:]:
        mean += one
    mean /= len(predictions)
    differences = [one - mean for one in predictions]
    variance = differences[0].square()
    for one in differences[1:]:
        variance.addcmul_(one, one)
    return differences, variance.div_(len(predictions))


def ensemble_loss(predictions: Sequence[torch.Tensor] | torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """
    Squared error summed over heads and dimensions: a head learns the same whatever the number of the others.

    :param predictions: of each head, shape ``(n, dim)``
    :param targets: shape ``(n, dim)``
    """
    if is_plain(targets):
        errors = [squared_error(one, targets).sum() for one in predictions]
    else:  # on a GPU launching operations is what takes time
        errors = [0.5 * F.mse_loss(one, targets, reduction="sum") for one in predictions]
    return torch.stack(errors).sum() / len(targets)
