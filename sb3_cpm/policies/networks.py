"""The networks of these policies."""

from itertools import pairwise

import torch as th
import torch.nn.functional as F
from torch import nn


class RunningNorm(nn.Module):
    """
    Standardises the first numbers of its input by their running mean and variance over everything seen in training (RSNorm,
    Lee et al. 2024, section 4.1), and lets the others, actions, pass.

    SB3 copies what is called ``running_`` into target networks, as of batch normalisation.

    :param size: of what is standardised
    """

    running_mean: th.Tensor
    running_var: th.Tensor
    running_count: th.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size
        self.register_buffer("running_mean", th.zeros(size))
        self.register_buffer("running_var", th.ones(size))
        self.register_buffer("running_count", th.zeros(()))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: shape ``(batch, size + others)``
        :return: the same shape
        """
        standardised, others = inputs.split((self.size, inputs.shape[1] - self.size), dim=1)
        if self.training and th.is_grad_enabled():
            self._update(standardised.detach())
        return th.cat(((standardised - self.running_mean) / (self.running_var + 1e-5).sqrt(), others), dim=1)

    @th.no_grad()
    def _update(self, batch: th.Tensor) -> None:
        """Mean and variance of two samples together (Chan et al. 1979)."""
        n = len(batch)
        total = self.running_count + n
        delta = batch.mean(0) - self.running_mean
        squares = self.running_var * self.running_count + batch.var(0, correction=0) * n
        self.running_var.copy_((squares + delta.square() * self.running_count * n / total) / total)
        self.running_mean += delta * n / total
        self.running_count.copy_(total)


class ResidualBlock(nn.Module):
    """
    ``x + W2 relu(W1 norm(x))`` with a hidden layer of four times the width (Lee et al. 2024, section 4.1).

    :param width: of its input and output
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.layers = nn.Sequential(nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))
        for layer in self.layers:
            if isinstance(layer, nn.Linear):
                nn.init.kaiming_normal_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return inputs + self.layers(self.norm(inputs))


class Simba(nn.Sequential):
    """
    SimBa's trunk: running normalisation of the observation, a linear layer, residual blocks, layer normalisation.

    :param n_features: of the observation, the first numbers of the input
    :param n_inputs: of the whole input
    :param net_arch: width of each block, all alike
    :raises ValueError: for blocks of different widths, or none
    """

    def __init__(self, n_features: int, n_inputs: int, net_arch: list[int]) -> None:
        if not net_arch or len(set(net_arch)) > 1:
            raise ValueError(
                f"SimbaPolicy adds blocks to what came before, so they need one width: net_arch={net_arch} must be a list of "
                "one or more equal numbers, for instance dict(pi=[128], qf=[512, 512])."
            )
        width = net_arch[0]
        embed = nn.Linear(n_inputs, width)
        nn.init.orthogonal_(embed.weight)
        nn.init.zeros_(embed.bias)
        super().__init__(RunningNorm(n_features), embed, *(ResidualBlock(width) for _ in net_arch), nn.LayerNorm(width))


class MLPs(nn.Module):
    """
    Several MLPs computed as one: a layer of all of them is one batched product.

    :param n: number of MLPs
    :param n_inputs: size of the input, the same for all
    :param net_arch: sizes of the hidden layers
    :param activation_fn: after each hidden layer
    :param layer_norm: normalise each hidden layer before its activation
    """

    def __init__(
        self, n: int, n_inputs: int, net_arch: list[int], activation_fn: type[nn.Module] = nn.ReLU, layer_norm: bool = True
    ) -> None:
        super().__init__()
        self.activation = activation_fn()
        self.weights, self.biases, self.scales, self.shifts = (nn.ParameterList() for _ in range(4))
        sizes = [n_inputs, *net_arch, 1]
        for size_in, size_out in pairwise(sizes):
            bound = size_in**-0.5  # as torch's nn.Linear, each on its own
            self.weights.append(nn.Parameter(th.empty(n, size_in, size_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(th.empty(n, 1, size_out).uniform_(-bound, bound)))
        for size in net_arch if layer_norm else ():
            self.scales.append(nn.Parameter(th.ones(n, 1, size)))
            self.shifts.append(nn.Parameter(th.zeros(n, 1, size)))

    def forward(self, inputs: th.Tensor, chosen: th.Tensor | None = None, frozen: bool = False) -> th.Tensor:
        """
        :param inputs: shape ``(batch, n_inputs)``
        :param chosen: which MLPs, shape ``(m,)``; None: all n
        :param frozen: only the inputs get a gradient
        :return: shape ``(m, batch, 1)``
        """

        def pick(parameter: th.Tensor) -> th.Tensor:
            parameter = parameter.detach() if frozen else parameter
            return parameter if chosen is None else parameter[chosen]

        values = inputs.expand(len(pick(self.biases[-1])), *inputs.shape)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if layer > 0:
                values = self.activation(values)
            values = th.baddbmm(pick(bias), values, pick(weight))  # (m, batch, size_out)
            if layer < len(self.scales):
                values = th.addcmul(
                    pick(self.shifts[layer]), F.layer_norm(values, values.shape[-1:]), pick(self.scales[layer])
                )
        return values
