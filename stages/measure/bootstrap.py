"""Is one better than the other? Paired differences, resampled, with what may be said of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DRAWS = 10_000
CONFIDENCE = 0.95
_SEED = 0  # equal differences get equal intervals, today and tomorrow
BETTER, WORSE, INCONCLUSIVE = "better", "worse", "not told apart"


@dataclass(frozen=True)
class Difference:
    """mean of the differences and the 95 % interval around it, in their own unit.
    photographs, seeds: how many of each were drawn from."""

    mean: float
    low: float
    high: float
    photographs: int
    seeds: int

    @property
    def verdict(self) -> str:
        """ "better" or "worse" where the interval leaves 0 out, else "not told apart"."""
        if self.low > 0:
            return BETTER
        return WORSE if self.high < 0 else INCONCLUSIVE


def paired_difference(differences: NDArray[np.floating]) -> Difference:
    """What differences (candidate minus baseline, larger is better) say of the mean.

    differences: [photographs] or [photographs, seeds]. Photographs and seeds are drawn with
    replacement, independently of each other: the interval is about other photographs of the scene,
    and, where there are several, about other seeds. A single photograph tells nothing of others,
    so its interval has no ends; a single seed is taken as it is.

    Few values resampled spread less than what they were drawn from: the interval is widened by
    Student's factor for the smaller of the two counts, and by sqrt(n / (n - 1)).

    Raises ValueError if there are none, or one is not finite.
    """
    table = np.asarray(differences, np.float64)
    table = table[:, None] if table.ndim == 1 else table
    if table.ndim != 2 or not table.size or not np.isfinite(table).all():
        raise ValueError("differences must be [photographs] or [photographs, seeds], all finite")
    photographs, seeds = table.shape
    mean = float(table.mean())
    if photographs == 1:
        return Difference(mean, -math.inf, math.inf, photographs, seeds)
    random = np.random.default_rng(_SEED)
    rows, columns = (_shares(random, count) for count in (photographs, seeds))
    means = np.einsum("dp,ps,ds->d", rows, table, columns, optimize=True)
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(means, (tail, 100 - tail)) - mean
    wider = _widening(min(count for count in table.shape if count > 1))
    return Difference(mean, mean + wider * low, mean + wider * high, photographs, seeds)


def _shares(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """[DRAWS, count] the share of each in a sample of as many, drawn with replacement."""
    return random.multinomial(count, np.full(count, 1 / count), size=DRAWS) / count


def _widening(count: int) -> float:
    from scipy.special import ndtri, stdtrit

    tail = (1 + CONFIDENCE) / 2
    return float(stdtrit(count - 1, tail) / ndtri(tail) * math.sqrt(count / (count - 1)))
