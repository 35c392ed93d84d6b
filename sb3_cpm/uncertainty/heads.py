"""
What an ensemble computes on CPUs, with gradients by hand: its heads' predictions, their disagreement, and both in one.

Composed of PyTorch's operations, each of a dozen would read and write all predictions, the gradients of the heads' weights
would be copied together, and what ten heads compute of 12000 imagined states, most of a gigabyte, would be kept.
"""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

import torch as th
from torch.autograd.function import once_differentiable

from sb3_cpm.uncertainty.scale import EPSILON, root
from sb3_cpm.world_model.fast.acceleration import cache_slices
from sb3_cpm.world_model.fast.activation import elu_, elu_gradient_
from sb3_cpm.world_model.fast.linear import add_product_, affine, multiply
from sb3_cpm.world_model.fast.one_hot import Choice

RATED_ROWS = 1024  # states that go through all heads before the next ones

Tensors = Sequence[th.Tensor]


class Predictions(th.autograd.Function):
    """
    Inputs and, as :func:`_forward` has them, choice, weights and biases to each head's output. All heads' weights are one
    parameter, whose gradient is written head by head.
    """

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, choice: Choice | None, *parameters: th.Tensor) -> tuple[th.Tensor, ...]:
        layers = len(parameters) // 2
        outputs, hidden = _forward(inputs, choice, parameters[:layers], parameters[layers:])
        ctx.choice = choice
        ctx.save_for_backward(inputs, *parameters[:layers], *chain.from_iterable(hidden))
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs_learn, _, weights_learn, *others = ctx.needs_input_grad
        layers = (1 + len(others)) // 2
        inputs, *saved = ctx.saved_tensors
        weights, hidden = saved[:layers], saved[layers:]
        to_inputs = th.zeros_like(inputs) if inputs_learn else None
        to_weights = [th.empty_like(weight) for weight in weights] if weights_learn else []
        to_biases = [weight.new_empty(len(weight), 1, weight.shape[-1]) for weight in weights] if weights_learn else []
        for head, to_output in enumerate(gradients):
            values = [inputs, *hidden[head * (layers - 1) : (head + 1) * (layers - 1)]]
            matrices = [weight[head] for weight in weights]
            for layer, gradient in _backward(to_output.contiguous(), values, matrices):  # of a sum it has no strides
                if weights_learn:
                    th.sum(gradient, 0, out=to_biases[layer][head, 0])
                    if layer == 0 and ctx.choice is not None:
                        ctx.choice.write_gradient(inputs, gradient, to_weights[layer][head])
                    else:
                        multiply(values[layer].t(), gradient.t(), out=to_weights[layer][head])
                if layer == 0 and to_inputs is not None:
                    add_product_(to_inputs, gradient, matrices[0])
        return to_inputs, None, *(to_weights + to_biases if weights_learn else [None] * 2 * layers)


class Disagreement(th.autograd.Function):
    """
    Predictions of each head to their disagreement. Its gradient: d/dp_k of the standard deviation s is (p_k - mean) / (K * s).

    Imagination rates 12000 states at once, so the predictions are larger than any cache. A slice of rows after the other is
    read from memory once.
    """

    @staticmethod
    def forward(ctx: Any, *predictions: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(*predictions)
        dim = predictions[0].shape[-1]
        slices = cache_slices(*(one.view(-1, dim) for one in predictions))
        result = th.cat([root(_spread(parts)[1]).mean(-1) for parts in slices])
        return result.view(predictions[0].shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, ...]:
        predictions = ctx.saved_tensors
        dim = predictions[0].shape[-1]
        results = [th.empty_like(one) for one in predictions]
        scale = gradient.reshape(-1, 1)
        for weight, *parts in cache_slices(scale, *(one.view(-1, dim) for one in (*predictions, *results))):
            _write_slopes(*_spread(parts[: len(predictions)]), weight, parts[len(predictions) :])
        return tuple(results)


class Rating(th.autograd.Function):
    """
    :class:`Disagreement` of :class:`Predictions`, differentiable with respect to the inputs only.

    A state is rated by one number, so that the rating's gradient is known with it, up to a factor that comes later. One slice
    of the states after the other goes through all heads, there and back, and nothing but that gradient is kept.
    """

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, choice: Choice | None, *parameters: th.Tensor) -> th.Tensor:
        layers = len(parameters) // 2
        weights, biases = parameters[:layers], parameters[layers:]
        slopes = th.zeros_like(inputs) if ctx.needs_input_grad[0] else None
        ratings = []
        for start in range(0, len(inputs), RATED_ROWS):
            rows = slice(start, start + RATED_ROWS)
            part, chosen = inputs[rows], None if choice is None else choice[rows]
            outputs, hidden = _forward(part, chosen, weights, biases)
            for parts in cache_slices(*outputs):
                differences, variance = _spread(parts)
                ratings.append(root(variance).mean(-1))
                if slopes is not None:
                    _write_slopes(differences, variance, 1.0, parts)
            if slopes is not None:
                for head, to_output in enumerate(outputs):
                    matrices = [weight[head] for weight in weights]
                    *_, (_, to_first) = _backward(to_output, [part, *hidden[head]], matrices)
                    add_product_(slopes[rows], to_first, matrices[0])
        if slopes is not None:
            ctx.save_for_backward(slopes)
        return th.cat(ratings)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return slopes * gradient.unsqueeze(-1), *[None] * (len(ctx.needs_input_grad) - 1)


def _forward(
    inputs: th.Tensor, choice: Choice | None, weights: Tensors, biases: Tensors
) -> tuple[list[th.Tensor], list[list[th.Tensor]]]:
    """
    :param inputs: shape ``(n, input_dim)``
    :param choice: what their one-hot vectors say
    :param weights: of each layer, shape ``(heads, size_in, size_out)``
    :param biases: of each layer, shape ``(heads, 1, size_out)``
    :return: each head's output, and its hidden layers
    """
    outputs, hidden = [], []
    for head in range(len(weights[0])):
        output, values = inputs, []
        for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            if layer > 0:
                output = elu_(output)
                values.append(output)
            if layer == 0 and choice is not None:
                output = choice.affine(inputs, weight[head], bias[head, 0])
            else:
                output = affine(output, weight[head], bias[head, 0])
        outputs.append(output)
        hidden.append(values)
    return outputs, hidden


def _backward(gradient: th.Tensor, values: Tensors, matrices: Tensors) -> Iterator[tuple[int, th.Tensor]]:
    """
    :param gradient: of a head's output
    :param values: what went into each of its layers
    :param matrices: of its layers
    :return: for each layer, from the last to the first, its number and the gradient of its product
    """
    for layer in reversed(range(len(matrices))):
        yield layer, gradient
        if layer > 0:
            gradient = elu_gradient_(multiply(gradient, matrices[layer]), values[layer])


def _spread(predictions: Tensors) -> tuple[list[th.Tensor], th.Tensor]:
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


def _write_slopes(differences: Tensors, variance: th.Tensor, weight: th.Tensor | float, out: Tensors) -> None:
    """
    :param differences: see :func:`_spread`; shape ``(n, dim)``
    :param variance: the same; overwritten
    :param weight: gradient of the disagreement, shape ``(n, 1)``
    :param out: where the gradients of the heads' predictions are written
    """
    slope = weight / variance.add_(EPSILON**2).sqrt_().mul_(len(differences) * variance.shape[-1])
    for difference, one in zip(differences, out, strict=True):
        th.mul(difference, slope, out=one)
