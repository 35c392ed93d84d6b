"""
Dynamic hyperparameter targeting: coefficients that keep a ratio between two drifting quantities.

Report, section 4.5 and Algorithm 2 (appendix B.7). Rewards, uncertainties and embeddings change their magnitude by
orders during training; a fixed coefficient between them would be wrong most of the time.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from sb3_cpm.arguments import ABOVE_0, check, check_each, choice

#: Coefficients stay within these bounds whatever the statistics do.
MIN_COEFFICIENT, MAX_COEFFICIENT = 1e-8, 1e8


class DynamicCoefficient:
    """
    A coefficient c held so that ``mean(|c * value|)`` stays near ``target_ratio * mean(|reference|)``.

    Algorithm 2 moves c by one factor per call when the ratio leaves the tolerance interval. With ``calibrate`` the
    first usable pair of statistics sets c to the target exactly instead of waiting for that many steps: without it the
    first challenges of a run would carry rewards that are off by orders of magnitude (an L1 distance of embeddings is
    in the hundreds, a reward near 0.1). ``calibrate=False`` is the report's own variant.

    A call leaves the coefficient as it is when either statistic is zero or not finite, or when there are no values: a
    sparse reward of zero must not blow its coefficient up.

    :param target_ratio: r*, the wanted ratio of the scaled value's mean to the reference's mean, > 0
    :param low: lower tolerance (omega_low), a factor on the target ratio
    :param high: upper tolerance (omega_high), likewise
    :param factor: lambda > 1, by which the coefficient moves. ``low * factor < high / factor`` is required: otherwise a
        step from one side of the interval can land on the other and the coefficient oscillates for ever.
    :param initial: the coefficient before the first call
    :param calibrate: set the coefficient to the exact target at the first usable call
    :param statistic: ``"magnitude"``: means of absolute values; ``"mean"``: means as the report prints them [B.6]. Means of
        opposite signs then leave the coefficient as it is
    :raises ValueError: for settings that cannot settle
    """

    def __init__(
        self,
        target_ratio: float,
        low: float = 0.75,
        high: float = 4 / 3,
        factor: float = 1.15,
        initial: float = 1.0,
        calibrate: bool = True,
        statistic: Literal["magnitude", "mean"] = "magnitude",
    ):
        check_each(ABOVE_0, target_ratio=target_ratio, low=low, high=high, factor=factor, initial=initial)
        if not factor > 1:
            raise ValueError(f"factor (lambda) must be greater than 1, got {factor}; the report uses 1.1 to 1.5")
        if not low < high:
            raise ValueError(f"Tolerances must satisfy 0 < low < high, got low={low}, high={high}")
        if not low * factor < high / factor:
            raise ValueError(
                f"Tolerances low={low}, high={high} with factor={factor} oscillate: low * factor = {low * factor:.3g} must be "
                f"below high / factor = {high / factor:.3g}. Widen the interval, or use a factor below "
                f"{(high / low) ** 0.5:.3g}."
            )
        if not MIN_COEFFICIENT <= initial <= MAX_COEFFICIENT:
            raise ValueError(f"initial must lie in [{MIN_COEFFICIENT}, {MAX_COEFFICIENT}], got {initial}")
        check("statistic", statistic, choice("magnitude", "mean"))
        self.target_ratio = target_ratio
        self.statistic = statistic
        self.low = low
        self.high = high
        self.factor = factor
        self.value = float(initial)
        self._calibrated = not calibrate

    def update(
        self, values: np.ndarray | Sequence[float], reference: np.ndarray | Sequence[float], provisional: bool = False
    ) -> float:
        """
        Adjust the coefficient to one trajectory or batch, at most by one factor.

        :param values: what the coefficient scales, any shape
        :param reference: what the scaled values are compared with, any shape
        :param provisional: the reference stands in for one that is still to come: the calibration is left for that one
        :return: the coefficient to use now
        """
        value, wanted = self._mean(values), self.target_ratio * self._mean(reference)
        if value < 0 and wanted < 0:
            value, wanted = -value, -wanted
        if not (np.isfinite(value) and np.isfinite(wanted) and value > 0 and wanted > 0):
            return self.value
        if not self._calibrated:
            self._calibrated = not provisional
            self.value = wanted / value
        elif self.value * value < self.low * wanted:
            self.value *= self.factor
        elif self.value * value > self.high * wanted:
            self.value /= self.factor
        self.value = float(np.clip(self.value, MIN_COEFFICIENT, MAX_COEFFICIENT))
        return self.value

    def _mean(self, values: np.ndarray | Sequence[float]) -> float:
        """:return: the statistic; nan for no values"""
        values = np.asarray(values, dtype=np.float64)
        if not values.size:
            return float("nan")
        return float(values.mean() if self.statistic == "mean" else np.abs(values).mean())
