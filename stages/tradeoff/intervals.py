"""Whether one of two results is better: the mean of paired differences of views (in their unit,
mostly dB of PSNR), and an interval of their mean over a dozen other views of the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

CONFIDENCE = 0.9
OTHERS = 12  # views of the scene that an interval is about, or as many as are held out, if more
OTHER_VIEWS = f"other views, {100 * CONFIDENCE:.0f} %"  # what an interval is of, in words
TRAINING_VIEWS = 24  # at most, evenly spaced, that say how differences vary in a scene
# Differences of held-out views vary so many times as far as those of training views, whose variance
# counts as that of so many more held-out views: docs/experiments/evaluation.md.
_WIDER, _WORTH = 1.2, 5
BETTER, WORSE, INCONCLUSIVE = "better", "worse", "no significant difference"


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences and its interval, in their unit.

    Args:
        mean: of the held-out views, candidate minus baseline.
        low, high: ends of the interval, which holds the mean of a dozen other views of the scene
            in `CONFIDENCE` of cases; infinite without two training views at least.
        views: how many the mean is of.
    """

    mean: float
    low: float
    high: float
    views: int

    @property
    def shown(self) -> bool:
        """Whether the interval has ends."""
        return math.isfinite(self.low)

    @property
    def verdict(self) -> str:
        """`BETTER` or `WORSE` where the interval excludes 0, else `INCONCLUSIVE`."""
        if self.low > 0:
            return BETTER
        return WORSE if self.high < 0 else INCONCLUSIVE


def paired_difference(held_out: ArrayLike, training: ArrayLike) -> Difference:
    """The mean of differences (candidate minus baseline, larger is better) and its interval.

    Few views do not say how far views differ. Training views do: their mean is not that of unseen
    views, but their variance is close to it. The sums of squares of both are joined, as those of
    two samples of one variance are, and the interval is Student's for the difference of two means:
    that of the held-out views and that of `OTHERS`.

    Args:
        held_out: [views], of views that no result was trained on.
        training: [views], of views that both were trained on.

    Raises:
        ValueError: there is no held-out view, or a difference is not finite.
    """
    unseen, seen = np.asarray(held_out, np.float64), np.asarray(training, np.float64)
    if not unseen.size or not (np.isfinite(unseen).all() and np.isfinite(seen).all()):
        raise ValueError("differences must be of one held-out view at least, all finite")
    mean, views, worth = float(unseen.mean()), len(unseen), min(_WORTH, len(seen) - 1)
    if worth < 1:
        return Difference(mean, -math.inf, math.inf, views)
    squares = views * unseen.var() + worth * _WIDER**2 * seen.var(ddof=1)
    freedom = views - 1 + worth
    half = half_width(squares / freedom * (1 / views + 1 / max(OTHERS, views)), freedom)
    return Difference(mean, mean - half, mean + half, views)


def half_width(variance: float, freedom: int) -> float:
    """Of Student's interval, from the variance of its middle and the degrees of freedom of that."""
    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * math.sqrt(variance)
