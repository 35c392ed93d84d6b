"""
The building blocks of the world model (report, B.1): MLPs, convolutional encoder and decoder, layer-norm GRU cell.

Initial weights are torch's own. Glorot's, as in Dreamer's TensorFlow original, start with larger outputs and learnt more
slowly here: open-loop pixel error after 300 updates of a moving square 0.074 instead of 0.063.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_cpm.world_model.fast.activation import ELU
from sb3_cpm.world_model.fast.deconvolution import Deconvolution
from sb3_cpm.world_model.fast.linear import Linear
from sb3_cpm.world_model.fast.one_hot import OneHot, OneHotLinear
from sb3_cpm.world_model.observations import MIN_FEATURE_MAP, Inputs, ObservationSpec

CACHED_NUMBERS = 2**21  # of a feature map that several operations find in the cache, 8 MB


def channels_last(module: nn.Sequential) -> nn.Sequential:
    """Store the weights of convolutions as the images come, channels last."""
    return module.to(memory_format=th.channels_last)  # type: ignore[call-overload]  # missing in torch's own types


class MLP(nn.Sequential):
    """
    Dense layers with ELU, and a linear output layer where ``output_dim`` is given.

    :param input_dim: size of the input
    :param layers: number of hidden layers
    :param units: size of each of them
    :param output_dim: size of the linear output layer; None ends with the last hidden layer's ELU
    :param one_hot: which inputs are one-hot vectors
    """

    def __init__(
        self, input_dim: int, layers: int, units: int, output_dim: int | None = None, one_hot: OneHot | None = None
    ) -> None:
        modules: list[nn.Module] = []
        for layer in range(layers):
            modules += [Linear(input_dim, units) if layer else OneHotLinear(input_dim, units, one_hot), ELU()]
            input_dim = units
        if output_dim is not None:
            modules.append(Linear(input_dim, output_dim))
        super().__init__(*modules)
        self.output_dim = input_dim if output_dim is None else output_dim

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: shape ``(*batch, input_dim)``
        :return: shape ``(*batch, output_dim)``
        """
        # as matrices: of more dimensions, a layer returns a view, and an ELU in place on a view has its gradient copied twice
        return super().forward(inputs.reshape(-1, inputs.shape[-1])).view(*inputs.shape[:-1], self.output_dim)


class GRUCell(nn.Module):
    """
    GRU with layer norm over all gates and an update bias of -1: a fresh cell keeps most of its memory (DreamerV2).

    :param input_dim: size of the input
    :param size: size of the hidden state
    """

    update_bias = -1.0

    def __init__(self, input_dim: int, size: int) -> None:
        super().__init__()
        self.gates = Linear(input_dim + size, 3 * size, bias=False)
        # after a reset memory, state and action are all zero: a smaller eps would blow up the gradient there
        self.norm = nn.LayerNorm(3 * size, eps=1e-3)

    def forward(self, inputs: th.Tensor, hidden: th.Tensor) -> th.Tensor:
        # float(): does nothing, unless mixed precision is on, whose rounding must not accumulate in the memory
        gates = self.norm(self.gates(th.cat((inputs, hidden), dim=-1)).float()).float()
        reset, candidate, update = gates.chunk(3, dim=-1)
        candidate = th.tanh(th.sigmoid(reset) * candidate)
        return th.lerp(hidden, candidate, th.sigmoid(update + self.update_bias))


class Pyramid(NamedTuple):
    """
    How often an image is halved. One whose sides cannot be halved that often is padded, at the bottom and on the right: 84x84
    pixels with four layers to 96x96.

    :param layers: number of halvings
    :param height: of the padded image, pixels
    :param width: of the padded image, pixels
    """

    layers: int
    height: int
    width: int

    @classmethod
    def of(cls, height: int, width: int, wanted: int) -> "Pyramid":
        """
        :param height: of the image, pixels
        :param width: of the image, pixels
        :param wanted: layers that are asked for; images so small that no 2x2 feature map would be left get fewer
        """
        layers = wanted
        while layers > 1 and min(height, width) // 2**layers < MIN_FEATURE_MAP:
            layers -= 1
        step = 2**layers
        return cls(layers, -(-height // step) * step, -(-width // step) * step)

    @property
    def smallest(self) -> tuple[int, int]:
        """Height and width of the last feature map."""
        return self.height // 2**self.layers, self.width // 2**self.layers


def convolve(convolutions: nn.Sequential, inputs: th.Tensor, largest: int) -> th.Tensor:
    """
    Apply convolutions; on CPUs to as many images at a time as their feature maps fit into a cache.

    :param convolutions: the layers
    :param inputs: shape ``(n, channels, height, width)``
    :param largest: numbers of an image's largest feature map
    """
    rows = max(CACHED_NUMBERS // largest, 1)
    if inputs.device.type != "cpu" or len(inputs) <= rows:
        return convolutions(inputs)
    return th.cat([convolutions(part) for part in inputs.split(rows)])


class ConvEncoder(nn.Module):
    """
    Strided convolutions, each of which halves the image: 4 layers of depth 32 turn 32x32 into 2x2x256, the report's
    embedding of 32 * depth.

    With kernel 4, stride 2 and padding 1, encoder and decoder are mirror images at any size (see :class:`Pyramid` for those
    that cannot be halved); DreamerV2's kernels without padding fit 64x64 only.

    :param image_shape: ``(channels, height, width)``
    :param depth: channels of the first layer, doubled by each further one up to 8 * depth
    :param layers: number of convolutions
    """

    def __init__(self, image_shape: tuple[int, int, int], depth: int, layers: int) -> None:
        super().__init__()
        channels, height, width = image_shape
        pyramid = Pyramid.of(height, width, layers)
        #: pixels that are missing on the left, on the right, at the top, and at the bottom; None where none are
        self.padding = (0, pyramid.width - width, 0, pyramid.height - height) if pyramid[1:] != (height, width) else None
        modules: list[nn.Module] = []
        for layer in range(pyramid.layers):
            out = depth * min(2**layer, 8)
            modules += [nn.Conv2d(channels, out, kernel_size=4, stride=2, padding=1), ELU()]
            channels = out
        self.convolutions = channels_last(nn.Sequential(*modules))
        self.output_dim = channels * pyramid.smallest[0] * pyramid.smallest[1]
        self.largest = depth * pyramid.height * pyramid.width // 4

    def forward(self, images: th.Tensor) -> th.Tensor:
        if self.padding is not None:
            images = nn.functional.pad(images, self.padding)
        return convolve(self.convolutions, images, self.largest).flatten(1)


class ConvDecoder(nn.Module):
    """
    Mirror image of :class:`ConvEncoder` behind a linear layer; its output is the mean of a unit-variance Gaussian.

    :param input_dim: size of the latent
    :param image_shape: ``(channels, height, width)``
    :param depth: channels before the last layer
    :param layers: number of transposed convolutions
    :param one_hot: which inputs are one-hot vectors
    """

    def __init__(
        self, input_dim: int, image_shape: tuple[int, int, int], depth: int, layers: int, one_hot: OneHot | None = None
    ) -> None:
        super().__init__()
        channels, height, width = image_shape
        pyramid = Pyramid.of(height, width, layers)
        #: height and width of the image, where what is drawn is larger
        self.cut = (height, width) if pyramid[1:] != (height, width) else None
        widths = [depth * min(2**layer, 8) for layer in reversed(range(pyramid.layers))]
        self.feature_map = (widths[0], *pyramid.smallest)
        self.linear = OneHotLinear(input_dim, self.feature_map[0] * self.feature_map[1] * self.feature_map[2], one_hot)
        modules: list[nn.Module] = []
        for wide, narrow in pairwise(widths):
            modules += [Deconvolution(wide, narrow), ELU()]
        self.convolutions = channels_last(nn.Sequential(*modules, Deconvolution(widths[-1], channels)))
        self.largest = depth * pyramid.height * pyramid.width // 4

    def forward(self, feat: th.Tensor) -> th.Tensor:
        features = self.linear(feat).unflatten(1, self.feature_map)
        drawn = convolve(self.convolutions, features.contiguous(memory_format=th.channels_last), self.largest)
        if self.cut is None:
            return drawn
        return drawn[:, :, : self.cut[0], : self.cut[1]].contiguous(memory_format=th.channels_last)


class Encoder(nn.Module):
    """
    Observations to one embedding: images through the CNN, vectors through an MLP, side by side.

    :param spec: the observations
    :param depth: of the CNN
    :param layers: of the CNN
    :param vector_layers: hidden layers of the MLP
    :param vector_units: size of each of them
    """

    def __init__(self, spec: ObservationSpec, depth: int, layers: int, vector_layers: int, vector_units: int) -> None:
        super().__init__()
        self.cnn = None if spec.image_shape is None else ConvEncoder(spec.image_shape, depth, layers)
        self.mlp = None if spec.vector_dim == 0 else MLP(spec.vector_dim, vector_layers, vector_units)
        self.output_dim = sum(part.output_dim for part in (self.cnn, self.mlp) if part is not None)

    def forward(self, inputs: Inputs) -> th.Tensor:
        parts = []
        if self.cnn is not None:
            parts.append(self.cnn(inputs.images))
        if self.mlp is not None:
            parts.append(self.mlp(inputs.vectors))
        return th.cat(parts, dim=-1) if len(parts) > 1 else parts[0]


class Decoder(nn.Module):
    """
    Latents back to observations, in the form of :class:`Inputs`.

    :param feat_dim: size of the latent
    :param spec: the observations
    :param depth: of the CNN
    :param layers: of the CNN
    :param vector_layers: hidden layers of the MLP
    :param vector_units: size of each of them
    :param one_hot: which of the latent's numbers are one-hot vectors
    """

    def __init__(
        self,
        feat_dim: int,
        spec: ObservationSpec,
        depth: int,
        layers: int,
        vector_layers: int,
        vector_units: int,
        one_hot: OneHot | None = None,
    ) -> None:
        super().__init__()
        self.cnn = None if spec.image_shape is None else ConvDecoder(feat_dim, spec.image_shape, depth, layers, one_hot)
        vector = (feat_dim, vector_layers, vector_units, spec.vector_dim, one_hot)
        self.mlp = None if spec.vector_dim == 0 else MLP(*vector)

    def forward(self, feat: th.Tensor) -> Inputs:
        return Inputs(
            images=None if self.cnn is None else self.cnn(feat), vectors=None if self.mlp is None else self.mlp(feat)
        )


@contextmanager
def frozen(*parts: nn.Module | nn.Parameter) -> Iterator[None]:
    """
    Context in which parameters, and those of modules, are constants: what is computed with them is differentiable with respect
    to its inputs only, and nothing is computed for the weights. Optimizers pass over them meanwhile.
    """
    found = (one for part in parts for one in ([part] if isinstance(part, nn.Parameter) else part.parameters()))
    parameters = [parameter for parameter in found if parameter.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
