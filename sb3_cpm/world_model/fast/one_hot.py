"""
Dense layers that read categorical samples, on CPUs.

Of the 1224 numbers of DreamerV2's latent 1024 are 32 one-hot vectors. Their product with a matrix is a sum of 32 of its rows,
and a row's gradient is the sum over those who chose it: a thirtieth of the arithmetic, and in practice a third of the time.
What flows back into the samples is a gradient of all classes, and stays the product it is.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch as th
import torch.nn.functional as F
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.fast.linear import Linear, is_large, multiply

MIN_ROWS = 256  # below, finding out what was chosen costs more than it saves
WIDTH = 128  # columns of a matrix at a time, so few that all its rows stay in the cache while they are picked


class OneHot(NamedTuple):
    """
    The first inputs of a layer are so many one-hot vectors, side by side (or probabilities, which are multiplied as ever).

    :param groups: how many
    :param classes: numbers of each
    """

    groups: int
    classes: int

    @property
    def size(self) -> int:
        return self.groups * self.classes


class Choice:
    """
    Which class each variable has, in every row of a batch.

    :param columns: positions of the ones, shape ``(n, groups)``
    :param size: of all one-hot vectors together
    """

    def __init__(self, columns: th.Tensor, size: int) -> None:
        self.columns, self.size = columns, size

    def __getitem__(self, rows: slice) -> "Choice":
        return Choice(self.columns[rows], self.size)

    def add_up(self, matrix: th.Tensor) -> th.Tensor:
        """
        :param matrix: shape ``(size, size_out)``
        :return: the one-hot vectors' product with it, shape ``(n, size_out)``
        """
        parts = matrix.split(WIDTH, dim=1)
        return th.cat([F.embedding_bag(self.columns, part.contiguous(), mode="sum") for part in parts], dim=1)

    @cached_property
    def rows(self) -> tuple[th.Tensor, th.Tensor]:
        """For one position after the other the rows that have a one there, and where each position's begin."""
        groups = self.columns.shape[1]
        classes = self.columns % (self.size // groups)
        # NumPy sorts small integers by their digits, ten times faster than by comparing them
        order = np.argsort(classes.t().numpy().astype(np.uint16), axis=1, kind="stable")
        counts = th.bincount(self.columns.flatten(), minlength=self.size)
        return th.from_numpy(order.ravel()), counts.cumsum(0) - counts

    def affine(self, inputs: th.Tensor, matrix: th.Tensor, bias: th.Tensor) -> th.Tensor:
        """
        ``inputs @ matrix + bias``, without gradients.

        :param inputs: shape ``(n, size_in)``, of which the first are the one-hot vectors
        :param matrix: shape ``(size_in, size_out)``
        :param bias: shape ``(size_out,)``
        """
        rest = th.addmm(bias, inputs[:, self.size :], matrix[self.size :])
        return rest.add_(self.add_up(matrix[: self.size]))

    def write_gradient(self, inputs: th.Tensor, gradient: th.Tensor, to_matrix: th.Tensor) -> None:
        """
        :param inputs: of :meth:`affine`
        :param gradient: of its result
        :param to_matrix: where that of the matrix is written, ``inputs.T @ gradient``
        """
        order, starts = self.rows
        for part, to_part in zip(gradient.split(WIDTH, dim=1), to_matrix[: self.size].split(WIDTH, dim=1), strict=True):
            to_part.copy_(F.embedding_bag(order, part.contiguous(), starts, mode="sum"))
        to_matrix[self.size :] = inputs[:, self.size :].t() @ gradient


def find_choice(inputs: th.Tensor, one_hot: OneHot | None, size_out: int) -> Choice | None:
    """
    What was chosen, or None where looking does not pay (few rows, small matrices, everything but float32 on a CPU), or where
    the inputs are no samples but probabilities.

    :param inputs: shape ``(n, size_in)``
    :param one_hot: which of them are one-hot; None for a layer without such inputs
    :param size_out: of the layer
    """
    if one_hot is None or inputs.dim() != 2 or len(inputs) < MIN_ROWS or not is_large(inputs, size_out):
        return None
    inputs = inputs.detach()
    blocks = inputs[:, : one_hot.size].unflatten(1, one_hot)
    classes = (blocks @ th.arange(float(one_hot.classes))).long().clamp_(0, one_hot.classes - 1)
    columns = classes + one_hot.classes * th.arange(one_hot.groups)
    return Choice(columns, one_hot.size) if bool((inputs.gather(1, columns) == 1.0).all()) else None


def one_hot_affine(inputs: th.Tensor, choice: Choice, matrix: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """
    ``inputs @ matrix + bias``, differentiable once.

    :param inputs: shape ``(n, size_in)``
    :param choice: what their first numbers say
    :param matrix: shape ``(size_in, size_out)``
    :param bias: shape ``(size_out,)``
    """
    return _Product.apply(inputs, choice, matrix, bias)


class OneHotLinear(Linear):
    """
    ``torch.nn.Linear`` for inputs that begin with one-hot vectors.

    :param size_in: all inputs
    :param size_out: outputs
    :param one_hot: which inputs are one-hot; None for an ordinary layer
    """

    def __init__(self, size_in: int, size_out: int, one_hot: OneHot | None = None) -> None:
        super().__init__(size_in, size_out)
        self.one_hot = one_hot

    def forward(self, input: th.Tensor) -> th.Tensor:
        choice = find_choice(input, self.one_hot, len(self.weight))
        return super().forward(input) if choice is None else one_hot_affine(input, choice, self.weight.t(), self.bias)


class _Product(th.autograd.Function):
    """:func:`one_hot_affine`; the matrix may lie in memory either way, and its gradient lies as it does."""

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, choice: Choice, matrix: th.Tensor, bias: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(inputs, matrix)
        ctx.choice = choice
        return choice.affine(inputs, matrix, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs, matrix = ctx.saved_tensors
        choice: Choice = ctx.choice
        gradient = gradient.contiguous()  # the gradient of a sum has no strides
        to_inputs = to_matrix = to_bias = None
        if ctx.needs_input_grad[0]:
            to_inputs = multiply(gradient, matrix)
        if ctx.needs_input_grad[2]:
            to_matrix = th.empty_like(matrix)  # with its strides
            choice.write_gradient(inputs, gradient, to_matrix)
        if ctx.needs_input_grad[3]:
            to_bias = gradient.sum(0)
        return to_inputs, None, to_matrix, to_bias
