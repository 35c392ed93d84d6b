"""
From raw novelty to the scale that S, F and R work with: exp(k * d) - 1 with a dynamic k (report, B.2), or log(d).

Raw novelty has whatever scale the latents happen to have, which drifts while the world model learns. Every measure that knows
nothing but "more" and "less" can share this scale, and its numbers then mean the same to the challenge filter.
"""

import math
from abc import abstractmethod

import torch as th

from sb3_cpm.uncertainty.base import LatentSizes, Transitions, Uncertainty
from sb3_cpm.world_model.networks import frozen

METRICS = ("exp", "log")
MOST_ROWS = 256  # of a batch tell the scale as much as all of them
EPSILON = 1e-6  # keeps the gradient of a root finite where there is no novelty at all


def root(mean_square: th.Tensor) -> th.Tensor:
    """Square root that is 0 at 0 with a finite gradient there."""
    return ((mean_square + EPSILON**2).sqrt() - EPSILON).clamp(min=0.0)


def some_of(n: int) -> slice:
    """At most ``MOST_ROWS`` of ``n`` rows, evenly spread."""
    return slice(None, None, -(-n // MOST_ROWS) or 1)


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

    def first(self, disagreement: th.Tensor) -> float | None:
        """k that puts the upper quartile at 1; None if the batch says nothing."""
        quartile = float(th.quantile(disagreement.float(), 0.75)) if disagreement.numel() else math.nan
        return self._clamp(1.0 / quartile) if math.isfinite(quartile) and quartile > 0.0 else None

    def next(self, k: float, disagreement: th.Tensor) -> float:
        """k after seeing a batch of raw novelties."""
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


class ScaledUncertainty(Uncertainty):
    """
    A measure that says how new a transition is on any scale, :meth:`raw`, and lets the metric do the rest.

    :param sizes: sizes of latents and actions
    :param metric: "exp" is exp(k * d) - 1 with a dynamic scale k, at least 0; "log" is log(d), negative for d < 1
    :param mean_range: tolerated mean of k * d over a batch
    :param max_range: tolerated maximum of k * d over a batch; wide, so that one unknown region does not flatten all others
    :param scale_factor: by which k moves in one step, 1.5 in the report
    :param exponent_limit: beyond it, exp goes on as a straight line with the same slope: it cannot overflow, and the order of
        transitions and the gradient survive
    :raises ValueError: for an unknown metric
    """

    k: th.Tensor
    calibrated: th.Tensor

    def __init__(
        self,
        sizes: LatentSizes,
        metric: str = "exp",
        mean_range: tuple[float, float] = (0.35, 1.2),
        max_range: tuple[float, float] = (1.0, 6.0),
        scale_factor: float = 1.5,
        exponent_limit: float = 5.0,
    ) -> None:
        super().__init__(sizes)
        if metric not in METRICS:
            raise ValueError(f"`metric` must be one of {METRICS}, got {metric!r}.")
        self.metric, self.exponent_limit = metric, exponent_limit
        self.nonnegative = metric == "exp"
        self.rule = ExpScale(mean_range, max_range, scale_factor)
        self.register_buffer("k", th.ones(()))
        self.register_buffer("calibrated", th.zeros((), dtype=th.bool))

    @abstractmethod
    def raw(self, transitions: Transitions) -> th.Tensor:
        """d: how new on any scale, at least 0, in the manner of a standard deviation, shape ``(*batch,)``."""

    def novelty(self, transitions: Transitions) -> th.Tensor:
        with frozen(self):  # an actor climbs along its gradient; its own weights learn from the loss
            return self.rate(self.raw(transitions))

    def rate(self, raw: th.Tensor) -> th.Tensor:
        """The metric: raw novelty d to novelty, shape as given."""
        if self.metric == "log":
            return (raw + EPSILON).log()
        exponent = self.k * raw
        beyond = (exponent - self.exponent_limit).clamp(min=0.0)
        bounded = exponent.clamp(max=self.exponent_limit)
        return th.expm1(bounded) + math.exp(self.exponent_limit) * beyond

    @th.no_grad()
    def adapt(self, transitions: Transitions) -> dict[str, th.Tensor]:
        raw = self.raw_of_some(transitions)
        if self.metric == "exp":
            self._adapt_scale(raw)
        return {"raw_disagreement": raw.mean(), "disagreement": self.rate(raw).mean(), "exp_scale": self.k}

    def raw_of_some(self, transitions: Transitions) -> th.Tensor:
        """d of so many transitions that they tell the scale, shape ``(rows,)``."""
        return self.raw(transitions.select(some_of(len(transitions.feat))))

    def _adapt_scale(self, raw: th.Tensor) -> None:
        if bool(self.calibrated):
            self.k.fill_(self.rule.next(float(self.k), raw))
            return
        first = self.rule.first(raw)
        if first is not None:
            self.k.fill_(first)
            self.calibrated.fill_(True)
