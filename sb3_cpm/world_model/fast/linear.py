"""
Dense layers that are as fast as the processor allows.

On CPUs PyTorch multiplies float32 matrices with MKL, which on AMD's processors reaches half of the speed of oneDNN, which
PyTorch brings along for convolutions (measured: 100 and 210 GFLOP/s on one core of an EPYC with AVX-512). On Intel's it is
the other way round (measured on one core of a Xeon with AVX-512: MKL 75 to 120, oneDNN 56 to 116 GFLOP/s, slowest for
transposed matrices), so the processor decides; timing both instead would let two runs with one seed differ in the last bits.
The operator that reaches oneDNN is the one that ``torch.compile`` generates for dense layers. It has no gradient of its own,
hence the three products here. Where it is missing or something else is asked for (a GPU, float64, mixed precision, compiling,
small matrices), everything is PyTorch's own.
"""

import functools
from typing import Any

import torch as th
import torch.nn.functional as F
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.fast.acceleration import is_amd, is_plain

MIN_ROWS, MIN_MULTIPLICATIONS = 64, 2**22  # below, calling costs more than multiplying


class Linear(nn.Linear):
    """``torch.nn.Linear``, faster where :func:`linear` is."""

    def forward(self, input: th.Tensor) -> th.Tensor:
        return linear(input, self.weight, self.bias)


def linear(inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    ``inputs @ weight.T + bias``, differentiable once.

    :param inputs: shape ``(*batch, size_in)``
    :param weight: shape ``(size_out, size_in)``
    :param bias: shape ``(size_out,)``
    :return: shape ``(*batch, size_out)``
    """
    if not is_faster(inputs, len(weight)):
        return F.linear(inputs, weight, bias)
    flat = _Product.apply(inputs.reshape(-1, inputs.shape[-1]), weight, bias)
    return flat.view(*inputs.shape[:-1], len(weight))


def is_faster(inputs: th.Tensor, size_out: int) -> bool:
    """Whether the product of such inputs with a matrix of ``size_out`` rows should be oneDNN's."""
    return is_large(inputs, size_out) and prefers_onednn()


def is_large(inputs: th.Tensor, size_out: int) -> bool:
    """Whether the product of such inputs with a matrix of ``size_out`` rows keeps a CPU busy, in plain float32."""
    return (
        inputs.numel() >= MIN_ROWS * inputs.shape[-1] and inputs.numel() * size_out >= MIN_MULTIPLICATIONS and is_plain(inputs)
    )


@functools.cache
def prefers_onednn() -> bool:
    """Whether this process has a processor that is faster with oneDNN, and an oneDNN that works."""
    return is_amd() and onednn_works()


@functools.cache
def onednn_works() -> bool:
    """Whether the operator is there and right, with and without transposed matrices; tried once per process."""
    left, right, bias = th.arange(35.0).view(5, 7).cos(), th.arange(21.0).view(3, 7).sin(), th.ones(3)
    try:
        pairs = [(left, right), (left.t().contiguous().t(), right), (left, right.t().contiguous().t())]
        found = [_multiply(one, other, bias) for one, other in pairs]
    except (AttributeError, RuntimeError, TypeError):  # built without oneDNN, for another processor, another signature
        return False
    return all(th.allclose(one, F.linear(left, right, bias), atol=1e-4) for one in found)


def affine(inputs: th.Tensor, matrix: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """
    ``inputs @ matrix + bias`` of large matrices on a CPU, by the faster of both; no gradients.

    :param inputs: shape ``(n, size_in)``
    :param matrix: shape ``(size_in, size_out)``
    :param bias: shape ``(size_out,)``
    """
    return _multiply(inputs, matrix.t(), bias) if prefers_onednn() else th.addmm(bias, inputs, matrix)


def multiply(left: th.Tensor, right: th.Tensor, out: th.Tensor | None = None) -> th.Tensor:
    """``left @ right.T`` of large matrices on a CPU, by the faster of both, into ``out`` where given; no gradients."""
    if not prefers_onednn():
        return th.mm(left, right.t(), out=out)
    return _multiply(left, right) if out is None else out.copy_(_multiply(left, right))


def weight_gradient(gradient: th.Tensor, inputs: th.Tensor) -> th.Tensor:
    """
    Gradient of a layer's weight; no gradients of its own.

    :param gradient: of the layer's output, shape ``(n, size_out)``
    :param inputs: shape ``(n, size_in)``
    :return: shape ``(size_out, size_in)``
    """
    return _multiply(gradient.t(), inputs.t()) if is_faster(inputs, gradient.shape[-1]) else gradient.t() @ inputs


def add_product_(total: th.Tensor, left: th.Tensor, right: th.Tensor) -> None:
    """Add ``left @ right.T`` to ``total``; as :func:`multiply`."""
    if prefers_onednn():
        total.add_(_multiply(left, right))
    else:
        total.addmm_(left, right.t())


def _multiply(left: th.Tensor, right: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """``left @ right.T + bias`` for any strides without overlap."""
    return th.ops.mkldnn._linear_pointwise(left, right, bias, "none", [], "")


class _Product(th.autograd.Function):
    """:func:`linear` of matrices."""

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        ctx.save_for_backward(inputs, weight)
        return _multiply(inputs, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs, weight = ctx.saved_tensors
        gradient = gradient.contiguous()  # the gradient of a sum has no strides
        to_inputs = to_weight = to_bias = None
        if ctx.needs_input_grad[0]:
            to_inputs = _multiply(gradient, weight.t())
        if ctx.needs_input_grad[1]:
            to_weight = _multiply(gradient.t(), inputs.t())
        if ctx.needs_input_grad[2]:
            to_bias = gradient.sum(0)
        return to_inputs, to_weight, to_bias
