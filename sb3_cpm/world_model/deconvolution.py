"""
The decoder's last layer, which draws an image: faster on CPUs than PyTorch's transposed convolution, oneDNN's.

With kernel 4, stride 2 and padding 1 each output pixel reads 2x2 input pixels, and which weights it takes depends on whether
its row and its column are even. A transposed convolution into few channels is therefore an ordinary one, with a 2x2 kernel and
four times the channels, whose outputs only need to be put in their places. That takes about half of the time. The gradient is
faster the way it was, and so are layers with many channels, so those stay oneDNN's.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_cpm.world_model.acceleration import is_plain

MAX_CHANNELS = 16  # of the output
#: Taps of the kernel that read the input pixel before and at (even rows or columns), at and behind (odd ones).
TAPS = ((3, 1), (2, 0))


class Drawing(nn.ConvTranspose2d):
    """
    ``torch.nn.ConvTranspose2d`` with kernel 4, stride 2 and padding 1, faster where :func:`is_faster` says so.

    :param in_channels: of the input
    :param out_channels: of the output
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, kernel_size=4, stride=2, padding=1)

    def forward(self, input: torch.Tensor, output_size: list[int] | None = None) -> torch.Tensor:
        if self.bias is None or output_size is not None or not is_faster(input, self.out_channels):
            return super().forward(input, output_size)
        return _Drawing.apply(input, self.weight, self.bias)


def is_faster(inputs: torch.Tensor, out_channels: int) -> bool:
    """Whether inputs are plain images, and the output has few channels."""
    return inputs.dim() == 4 and out_channels <= MAX_CHANNELS and is_plain(inputs)


class _Drawing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(inputs, weight)
        n, _, height, width = inputs.shape
        channels = len(bias)
        taps = torch.tensor(TAPS, device=weight.device)
        # (in, out, row parity, tap of the row, column parity, tap of the column), parities side by side as channels
        kernel = weight[:, :, taps][..., taps].permute(2, 4, 1, 0, 3, 5).flatten(0, 2)
        kernel = kernel.contiguous(memory_format=torch.channels_last)
        drawn = F.conv2d(inputs, kernel, bias.repeat(4), padding=1).permute(0, 2, 3, 1).unflatten(-1, (2, 2, channels))
        result = inputs.new_empty(n, height, 2, width, 2, channels)
        for row in range(2):
            for column in range(2):
                part = drawn[:, row : row + height, column : column + width, row, column]
                result[:, :, row, :, column] = part
        return result.view(n, 2 * height, 2 * width, channels).permute(0, 3, 1, 2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, ...]:
        inputs, weight = ctx.saved_tensors
        two, one = [2, 2], [1, 1]
        return torch.ops.aten.convolution_backward(
            gradient, inputs, weight, [weight.shape[1]], two, one, one, True, [0, 0], 1, list(ctx.needs_input_grad)
        )
