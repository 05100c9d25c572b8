"""Whether one of two results is better: the mean of paired differences (in their unit, mostly dB of
PSNR) and its percentile bootstrap interval (Efron and Tibshirani 1993)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

RESAMPLES = 10_000
CONFIDENCE = 0.95
FEWEST_SHOWN = 5  # views: the interval of fewer says little, and is not shown
_SEED = 0  # equal differences get equal intervals
BETTER, WORSE, INCONCLUSIVE = "better", "worse", "no significant difference"


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences and its 95 % interval, in their unit.

    Args:
        mean: candidate minus baseline.
        low, high: ends of the interval; infinite for a single view.
        views: how many the differences are of.
    """

    mean: float
    low: float
    high: float
    views: int

    @property
    def shown(self) -> bool:
        """Whether the interval is of enough views to be shown."""
        return self.views >= FEWEST_SHOWN

    @property
    def verdict(self) -> str:
        """`BETTER` or `WORSE` where the interval excludes 0, else `INCONCLUSIVE`."""
        if self.low > 0:
            return BETTER
        return WORSE if self.high < 0 else INCONCLUSIVE


def paired_difference(differences: NDArray[np.floating]) -> Difference:
    """The mean of `differences` (candidate minus baseline, larger is better) and its interval.

    Views and seeds are resampled with replacement, independently of each other. So the interval is
    about other views of the scene and, where there are several seeds, about other seeds. It has no
    ends for a single view. A single seed is taken as it is.

    A resample of few values spreads less than the population that they come from: the interval is
    widened by the ratio of Student's quantile to the normal one, for the smaller of the two counts,
    and by sqrt(n / (n - 1)).

    Args:
        differences: [views] or [views, seeds].

    Raises:
        ValueError: there are none, or one is not finite.
    """
    table = np.asarray(differences, np.float64)
    table = table[:, None] if table.ndim == 1 else table
    if table.ndim != 2 or not table.size or not np.isfinite(table).all():
        raise ValueError("differences must be [views] or [views, seeds], all finite")
    views, seeds = table.shape
    mean = float(table.mean())
    if views == 1:
        return Difference(mean, -math.inf, math.inf, views)
    random = np.random.default_rng(_SEED)
    rows, columns = (_resample_weights(random, count) for count in (views, seeds))
    means = np.einsum("dp,ps,ds->d", rows, table, columns, optimize=True)
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(means, (tail, 100 - tail)) - mean
    wider = _widening(min(count for count in table.shape if count > 1))
    return Difference(mean, mean + wider * low, mean + wider * high, views)


def _resample_weights(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """[RESAMPLES, count] the weight of each value in a resample of as many."""
    return random.multinomial(count, np.full(count, 1 / count), size=RESAMPLES) / count


def _widening(count: int) -> float:
    tail = (1 + CONFIDENCE) / 2
    return float(stdtrit(count - 1, tail) / ndtri(tail) * math.sqrt(count / (count - 1)))
