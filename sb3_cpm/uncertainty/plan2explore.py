"""
Plan2Explore (Sekar et al. 2020, section 3; report, B.2): disagreement of an ensemble that predicts the next latent.

All K heads see the same transitions and converge to the same mean where data are plentiful, however noisy the transitions
are; where data are scarce they still say what their different initial weights say.
"""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import nn

from sb3_cpm.uncertainty.base import LatentSizes, Transitions, Uncertainty

TARGETS = ("feat", "stoch", "deter", "embed")
METRICS = ("exp", "log")


class Ensemble(nn.Module):
    """
    K MLPs with ELU and linear outputs, computed as one: every layer is a single batched matrix product.

    :param heads: K
    :param input_dim: size of the input
    :param output_dim: size of the output
    :param layers: hidden layers
    :param units: size of each of them
    """

    def __init__(self, heads: int, input_dim: int, output_dim: int, layers: int, units: int) -> None:
        super().__init__()
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


class ExpScale:
    """
    Rule for the factor k in exp(k * d) - 1 (report, B.2): the upper quartile of k * d shall sit near 1.

    The first valid batch sets k so that the quartile is 1. Then two tolerance intervals hold it, one for the mean and one for
    the maximum of k * d over a batch; outside, k moves by one factor. Where they contradict each other, or a step would leave
    the other interval, k stays: it settles instead of oscillating.

    :param mean_range: tolerated mean of k * d
    :param max_range: tolerated maximum of k * d; wide, so that one unknown region does not flatten everything else
    :param factor: of one step, 1.5 in the report
    """

    bounds = (1e-8, 1e8)

    def __init__(
        self, mean_range: tuple[float, float] = (0.35, 1.2), max_range: tuple[float, float] = (1.0, 6.0), factor: float = 1.5
    ) -> None:
        for name, (low, high) in (("mean_range", mean_range), ("max_range", max_range)):
            if not (factor > 1.0 and 0.0 < low * factor < high / factor):
                raise ValueError(
                    f"{name}={(low, high)} is too narrow for factor={factor}: a step has to end inside, so low * factor must "
                    "be smaller than high / factor. Widen the interval or lower the factor."
                )
        self.mean_range, self.max_range, self.factor = tuple(mean_range), tuple(max_range), factor

    def first(self, disagreement: torch.Tensor) -> float | None:
        """k that puts the upper quartile at 1; None if the batch says nothing."""
        quartile = float(torch.quantile(disagreement.float(), 0.75)) if disagreement.numel() else math.nan
        return self._clamp(1.0 / quartile) if math.isfinite(quartile) and quartile > 0.0 else None

    def next(self, k: float, disagreement: torch.Tensor) -> float:
        """k after seeing a batch of disagreements."""
        if not disagreement.numel():
            return k
        mean, peak = k * float(disagreement.mean()), k * float(disagreement.max())
        if not (math.isfinite(mean) and math.isfinite(peak)) or peak <= 0.0:
            return k
        (low_mean, high_mean), (low_peak, high_peak) = self.mean_range, self.max_range
        low, high = mean < low_mean or peak < low_peak, mean > high_mean or peak > high_peak
        if low and not high and mean * self.factor <= high_mean and peak * self.factor <= high_peak:
            k *= self.factor
        if high and not low and mean / self.factor >= low_mean and peak / self.factor >= low_peak:
            k /= self.factor
        return self._clamp(k)

    def _clamp(self, k: float) -> float:
        return min(max(k, self.bounds[0]), self.bounds[1])


class Plan2Explore(Uncertainty):
    """
    :param sizes: sizes of latents and actions
    :param heads: K, 10 in the report
    :param layers: hidden layers of each head
    :param units: size of each of them
    :param target: what the heads predict of state t+1: "feat" (the whole latent, the report's choice), "stoch", "deter" or
        "embed" (the paper's choice)
    :param metric: "exp" is exp(k * d) - 1 with a dynamic scale k, at least 0; "log" is log(d), negative for d < 1
    :param mean_range: see :class:`ExpScale`
    :param max_range: see :class:`ExpScale`
    :param scale_factor: see :class:`ExpScale`
    :param exponent_limit: beyond it, exp goes on as a straight line with the same slope: it cannot overflow, and the order of
        transitions and the gradient survive
    :raises ValueError: for unknown targets and metrics, fewer than two heads
    """

    k: torch.Tensor
    calibrated: torch.Tensor
    epsilon = 1e-6  # keeps the gradient of the standard deviation finite where all heads agree

    def __init__(
        self,
        sizes: LatentSizes,
        heads: int = 10,
        layers: int = 4,
        units: int = 400,
        target: str = "feat",
        metric: str = "exp",
        mean_range: tuple[float, float] = (0.35, 1.2),
        max_range: tuple[float, float] = (1.0, 6.0),
        scale_factor: float = 1.5,
        exponent_limit: float = 5.0,
    ) -> None:
        super().__init__(sizes)
        if target not in TARGETS:
            raise ValueError(f"`target` must be one of {TARGETS}, got {target!r}.")
        if metric not in METRICS:
            raise ValueError(f"`metric` must be one of {METRICS}, got {metric!r}.")
        if heads < 2:
            raise ValueError(f"Disagreement needs at least two `heads`, got {heads}.")
        self.target, self.metric, self.exponent_limit = target, metric, exponent_limit
        self.nonnegative = metric == "exp"
        output_dim = {"feat": sizes.feat, "stoch": sizes.stoch, "deter": sizes.deter, "embed": sizes.embed}[target]
        self.ensemble = Ensemble(heads, sizes.feat + sizes.action, output_dim, layers, units)
        self.rule = ExpScale(mean_range, max_range, scale_factor)
        self.register_buffer("k", torch.ones(()))
        self.register_buffer("calibrated", torch.zeros((), dtype=torch.bool))

    def predict(self, transitions: Transitions) -> torch.Tensor:
        """Predictions of all heads, shape ``(heads, *batch, target_dim)``."""
        inputs = torch.cat((transitions.feat, transitions.action), dim=-1)
        return self.ensemble(inputs.flatten(0, -2)).unflatten(1, inputs.shape[:-1])

    def disagreement(self, transitions: Transitions) -> torch.Tensor:
        """d: standard deviation over the heads, averaged over the target's dimensions, shape ``(*batch,)``, at least 0."""
        predictions = self.predict(transitions)
        # by hand: torch.var over a leading dimension takes ten times as long on a CPU
        variance = (predictions - predictions.mean(0)).square().mean(0)
        return ((variance + self.epsilon**2).sqrt() - self.epsilon).clamp(min=0.0).mean(-1)

    def novelty(self, transitions: Transitions) -> torch.Tensor:
        return self.rate(self.disagreement(transitions))

    def rate(self, disagreement: torch.Tensor) -> torch.Tensor:
        """The metric: raw disagreement d to novelty, shape as given."""
        if self.metric == "log":
            return (disagreement + self.epsilon).log()
        exponent = self.k * disagreement
        beyond = (exponent - self.exponent_limit).clamp(min=0.0)
        bounded = exponent.clamp(max=self.exponent_limit)
        return torch.expm1(bounded) + math.exp(self.exponent_limit) * beyond

    def loss(self, transitions: Transitions) -> torch.Tensor:
        """Squared error summed over heads and dimensions: a head learns the same whatever the number of the others."""
        error = self.predict(transitions) - self.targets(transitions)
        return 0.5 * error.square().sum((0, 2)).mean()

    def targets(self, transitions: Transitions) -> torch.Tensor:
        """What the heads shall predict, shape ``(*batch, target_dim)``."""
        if self.target == "feat":
            return torch.cat((transitions.next_stoch, transitions.next_deter), dim=-1)
        if self.target == "embed":
            assert transitions.next_embed is not None, "only real transitions have an embedding"
            return transitions.next_embed
        return transitions.next_stoch if self.target == "stoch" else transitions.next_deter

    @torch.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, torch.Tensor]:
        disagreement = self.disagreement(transitions)
        if self.metric == "exp":
            self._adapt_scale(disagreement)
        return {
            "raw_disagreement": disagreement.mean(),
            "disagreement": self.rate(disagreement).mean(),
            "exp_scale": self.k,
        }

    def _adapt_scale(self, disagreement: torch.Tensor) -> None:
        if bool(self.calibrated):
            self.k.fill_(self.rule.next(float(self.k), disagreement))
            return
        first = self.rule.first(disagreement)
        if first is not None:
            self.k.fill_(first)
            self.calibrated.fill_(True)
