"""K networks computed as one, and how much they disagree (Lakshminarayanan et al. 2017; Pathak et al. 2019, eq. 1)."""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import nn

from sb3_cpm.uncertainty.scale import root


class Ensemble(nn.Module):
    """
    K MLPs with ELU and linear outputs, computed as one: every layer is a single batched matrix product.

    :param heads: K
    :param input_dim: size of the input
    :param output_dim: size of the output
    :param layers: hidden layers
    :param units: size of each of them
    :raises ValueError: for fewer than two heads
    """

    def __init__(self, heads: int, input_dim: int, output_dim: int, layers: int, units: int) -> None:
        super().__init__()
        if heads < 2:
            raise ValueError(f"Disagreement needs at least two `heads`, got {heads}.")
        sizes = [input_dim, *[units] * layers, output_dim]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for size_in, size_out in pairwise(sizes):
            bound = math.sqrt(6.0 / (size_in + size_out))  # Glorot, for each head on its own
            self.weights.append(nn.Parameter(torch.empty(heads, size_in, size_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.zeros(heads, 1, size_out)))
        self.heads = heads

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
                hidden = F.elu(hidden)
        return hidden


def disagreement(predictions: torch.Tensor) -> torch.Tensor:
    """
    Standard deviation over the heads, averaged over the dimensions.

    :param predictions: shape ``(heads, *batch, dim)``
    :return: shape ``(*batch,)``, at least 0
    """
    # by hand: torch.var over a leading dimension takes ten times as long on a CPU
    return root((predictions - predictions.mean(0)).square().mean(0)).mean(-1)


def ensemble_loss(predictions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """
    Squared error summed over heads and dimensions: a head learns the same whatever the number of the others.

    :param predictions: shape ``(heads, n, dim)``
    :param targets: shape ``(n, dim)``
    """
    return 0.5 * (predictions - targets).square().sum((0, 2)).mean()
