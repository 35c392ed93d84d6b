"""
The decoder's transposed convolutions, faster on CPUs than PyTorch's, which are oneDNN's.

The bias's gradient is a plain sum, which oneDNN takes longer for than for the gradient of its weights (measured: 7.6 ms for
256 maps of 16x16x32 in the channels-last format, PyTorch's ``sum`` 0.4 ms).

With kernel 4, stride 2 and padding 1 each output pixel reads 2x2 input pixels, and which weights it takes depends on whether
its row and its column are even. A transposed convolution into few channels, the last layer that draws an image, is therefore
computed as an ordinary one, with a 2x2 kernel and four times the channels, whose outputs only need to be put in their places.
That takes less than half of the time. The gradient is faster the way it was, and so are layers with many channels.
"""

import functools
from typing import Any

import torch as th
import torch.nn.functional as F
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.fast.acceleration import is_plain

MAX_CHANNELS = 16  # of an output that is drawn
#: Taps of the kernel that read the input pixel before and at (even rows or columns), at and behind (odd ones).
TAPS = ((3, 1), (2, 0))


class Deconvolution(nn.ConvTranspose2d):
    """
    ``torch.nn.ConvTranspose2d`` with kernel 4, stride 2 and padding 1: it doubles height and width.

    :param in_channels: of the input
    :param out_channels: of the output
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, kernel_size=4, stride=2, padding=1)

    def forward(self, input: th.Tensor, output_size: list[int] | None = None) -> th.Tensor:
        if self.bias is None or output_size is not None or input.dim() != 4 or not is_plain(input):
            return super().forward(input, output_size)
        return _Deconvolution.apply(input, self.weight, self.bias)


class _Deconvolution(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(inputs, weight)
        if len(bias) <= MAX_CHANNELS:
            return _draw(inputs, weight, bias)
        return F.conv_transpose2d(inputs, weight, bias, stride=2, padding=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        inputs, weight = ctx.saved_tensors
        two, one, needed = [2, 2], [1, 1], list(ctx.needs_input_grad)
        to_inputs, to_weight, _ = th.ops.aten.convolution_backward(
            gradient, inputs, weight, None, two, one, one, True, [0, 0], 1, [*needed[:2], False]
        )
        return to_inputs, to_weight, gradient.sum((0, 2, 3)) if needed[2] else None


def _draw(inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """The transposed convolution by an ordinary one."""
    n, _, height, width = inputs.shape
    channels = len(bias)
    taps = th.tensor(TAPS, device=weight.device)
    # (in, out, row parity, tap of the row, column parity, tap of the column), parities side by side as channels
    kernel = weight[:, :, taps][..., taps].permute(2, 4, 1, 0, 3, 5).flatten(0, 2)
    drawn = F.conv2d(inputs, kernel.contiguous(memory_format=th.channels_last), bias.repeat(4), padding=1)
    shape = n, channels, 2 * height, 2 * width
    result = th.empty(shape, dtype=inputs.dtype, memory_format=th.channels_last)
    pixels = result.permute(0, 2, 3, 1).view(n, -1, channels)  # the result itself must be no view: ELU works in place
    th.index_select(drawn.permute(0, 2, 3, 1).reshape(n, -1, channels), 1, _places(height, width), out=pixels)
    return result


@functools.cache
def _places(height: int, width: int) -> th.Tensor:
    """
    Where an output's pixels are found, in their order.

    :param height: of the input
    :param width: of the input
    :return: indices into what the ordinary convolution gives: ``(height + 1, width + 1, row parity, column parity)``
    """
    found = th.arange((height + 1) * (width + 1) * 4).view(height + 1, width + 1, 2, 2)
    parts = [found[row : row + height, column : column + width, row, column] for row in range(2) for column in range(2)]
    return th.stack(parts, -1).view(height, width, 2, 2).transpose(1, 2).flatten()
