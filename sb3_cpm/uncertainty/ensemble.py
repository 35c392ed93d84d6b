"""K networks computed as one, and how much they disagree (Lakshminarayanan et al. 2017; Pathak et al. 2019, eq. 1)."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_cpm.uncertainty.base import Transitions
from sb3_cpm.uncertainty.heads import Disagreement, Predictions, Rating
from sb3_cpm.uncertainty.scale import ScaledUncertainty, some_of
from sb3_cpm.world_model.fast.acceleration import is_plain
from sb3_cpm.world_model.fast.activation import elu_
from sb3_cpm.world_model.fast.linear import is_large
from sb3_cpm.world_model.fast.one_hot import Choice, OneHot, find_choice
from sb3_cpm.world_model.losses import squared_error


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
            self.weights.append(nn.Parameter(th.empty(heads, size_in, size_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(th.zeros(heads, 1, size_out)))
        self.heads, self.one_hot = heads, one_hot

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: shape ``(n, input_dim)``
        :return: shape ``(heads, n, output_dim)``
        """
        hidden = inputs.expand(self.heads, *inputs.shape)
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = th.baddbmm(bias, hidden, weight)
            if layer < last:
                hidden = elu_(hidden)
        return hidden

    def predictions(self, inputs: th.Tensor) -> list[th.Tensor]:
        """
        The outputs of the heads, one by one, without copying them together.

        :param inputs: shape ``(*batch, input_dim)``
        :return: of each head, shape ``(*batch, output_dim)``
        """
        return [one.unflatten(0, inputs.shape[:-1]) for one in self._predictions(inputs.flatten(0, -2))]

    def disagreement(self, inputs: th.Tensor) -> th.Tensor:
        """
        What :func:`disagreement` says of the :meth:`predictions`.

        :param inputs: shape ``(*batch, input_dim)``
        :return: shape ``(*batch,)``, at least 0
        """
        return self._disagreement(inputs.flatten(0, -2)).unflatten(0, inputs.shape[:-1])

    def _predictions(self, inputs: th.Tensor) -> Sequence[th.Tensor]:
        if not self._keeps_a_cpu_busy(inputs):
            return self(inputs).unbind(0)
        return Predictions.apply(inputs, self._choice(inputs), *self.weights, *self.biases)

    def _disagreement(self, inputs: th.Tensor) -> th.Tensor:
        weights_learn = th.is_grad_enabled() and self.weights[0].requires_grad
        if weights_learn or not self._keeps_a_cpu_busy(inputs):
            return disagreement(self._predictions(inputs))
        return Rating.apply(inputs, self._choice(inputs), *self.weights, *self.biases)

    def _keeps_a_cpu_busy(self, inputs: th.Tensor) -> bool:
        """Then the heads are computed one by one: a head's layers fit into the cache."""
        return is_large(inputs, self.biases[0].shape[-1])

    def _choice(self, inputs: th.Tensor) -> Choice | None:
        """One for all heads."""
        return find_choice(inputs, self.one_hot, self.biases[0].shape[-1])


def disagreement(predictions: Sequence[th.Tensor] | th.Tensor) -> th.Tensor:
    """
    Standard deviation over the heads, averaged over the dimensions.

    :param predictions: of each head, shape ``(*batch, dim)``
    :return: shape ``(*batch,)``, at least 0
    """
    return Disagreement.apply(*predictions)


def ensemble_loss(predictions: Sequence[th.Tensor] | th.Tensor, targets: th.Tensor) -> th.Tensor:
    """
    Squared error summed over heads and dimensions: a head learns the same whatever the number of the others.

    :param predictions: of each head, shape ``(n, dim)``
    :param targets: shape ``(n, dim)``
    """
    if is_plain(targets):
        errors = [squared_error(one, targets).sum() for one in predictions]
    else:  # on a GPU launching operations is what takes time
        errors = [0.5 * F.mse_loss(one, targets, reduction="sum") for one in predictions]
    return th.stack(errors).sum() / len(targets)


class EnsembleUncertainty(ScaledUncertainty):
    """
    What measures of disagreement have in common: what the heads predicted of a batch while they learnt from it says how they
    disagree about it, without a further prediction.
    """

    ensemble: Ensemble
    #: latents of the batch learnt from last, and d of some of its transitions
    _rated: tuple[th.Tensor | None, th.Tensor | None] = None, None

    @abstractmethod
    def inputs(self, transitions: Transitions) -> th.Tensor:
        """What the heads read, shape ``(*batch, input_dim)``."""

    def predict(self, transitions: Transitions) -> list[th.Tensor]:
        """Predictions of all heads, each of shape ``(*batch, output_dim)``."""
        return self.ensemble.predictions(self.inputs(transitions))

    def raw(self, transitions: Transitions) -> th.Tensor:
        """d: standard deviation over the heads, averaged over the output's dimensions, shape ``(*batch,)``, at least 0."""
        return self.ensemble.disagreement(self.inputs(transitions))

    def remember(self, transitions: Transitions, predictions: Sequence[th.Tensor]) -> None:
        """
        :param transitions: a batch to learn from, batch dimension ``(n,)``
        :param predictions: of each head, shape ``(n, output_dim)``
        """
        with th.no_grad():
            rows = some_of(len(transitions.feat))
            self._rated = transitions.feat, disagreement([one[rows] for one in predictions])

    def raw_of_some(self, transitions: Transitions) -> th.Tensor:
        """Of the transitions learnt from last, as the heads predicted then."""
        feat, raw = self._rated
        self._rated = None, None
        return raw if feat is transitions.feat and raw is not None else super().raw_of_some(transitions)
