"""
Interquartile means with stratified bootstrap intervals (Agarwal et al. 2021, "Deep RL at the edge of the statistical
precipice").

A score is one number per seed: the mean over the evaluation episodes. With fewer than four seeds the interquartile mean is the
mean, and intervals of very few seeds are too narrow: figures say how many there were.
"""

import contextlib
import io
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_cpm.extras import needed

#: Bootstrap samples. rliable's example has 50000; 2000 are exact to a percent or two of the width.
REPETITIONS = 2000


class Estimate(NamedTuple):
    """
    An interquartile mean over seeds, one per step.

    :param steps: shape ``(n_steps,)``
    :param iqm: shape ``(n_steps,)``
    :param low: lower end of the 95% interval
    :param high: upper end
    :param n_seeds: how many seeds there were
    """

    steps: np.ndarray
    iqm: np.ndarray
    low: np.ndarray
    high: np.ndarray
    n_seeds: int


def per_seed(table: pd.DataFrame, value: str) -> pd.DataFrame:
    """
    :param table: with the columns ``seed``, ``step`` and the value, episodes as rows
    :return: mean over the episodes; a row per step that all seeds have, a column per seed; where a value is NaN or infinite a
        seed does not have that step
    """
    means = table.groupby(["step", "seed"])[value].agg(lambda values: values.mean(skipna=False)).unstack("seed")
    return means.where(np.isfinite(means)).dropna()


def estimate(scores: pd.DataFrame, repetitions: int = REPETITIONS) -> Estimate:
    """
    :param scores: a row per step, a column per seed
    :param repetitions: bootstrap samples
    :return: interquartile means and their intervals; the same for the same scores
    :raises MissingExtra: if rliable is missing
    """
    with needed("Intervals", "experiments"), contextlib.redirect_stderr(io.StringIO()):
        from rliable import library
    runs = scores.to_numpy().T[:, None, :]  # (seeds, one task, steps)

    if not len(scores) or len(runs) == 1:  # nothing to draw from
        values = runs[0, 0]
        return Estimate(scores.index.to_numpy(), values, values, values, len(runs))
    state = np.random.get_state()
    np.random.seed(0)  # rliable draws from NumPy's global generator
    try:
        points, intervals = library.get_interval_estimates({"": runs}, _iqm, reps=repetitions)
    finally:
        np.random.set_state(state)
    low, high = intervals[""]
    return Estimate(scores.index.to_numpy(), np.asarray(points[""]), low, high, len(runs))


def _iqm(runs: np.ndarray) -> np.ndarray:
    """Mean without the lowest and the highest quarter of the seeds, per step (``rliable.metrics`` takes all steps as one)."""
    cut = len(runs) // 4
    return np.sort(runs[:, 0], axis=0)[cut : len(runs) - cut].mean(axis=0)


def binned(table: pd.DataFrame, n_bins: int = 20) -> pd.DataFrame:
    """
    :param table: with a column ``step``
    :param n_bins: of equal width over all of it
    :return: the same, every step replaced by the end of its bin, so that seeds share steps
    """
    width = max(table["step"].max() / n_bins, 1e-9)
    return table.assign(step=(np.ceil(np.maximum(table["step"], 1e-9) / width) * width).round().astype(int))
