"""Whether one of two results is better: the mean of paired differences of views (in their unit,
mostly dB of PSNR), and an interval of their mean over a dozen other views of the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

CONFIDENCE = 0.9
OTHERS = 12  # views of the scene that an interval is about, or as many as are held out, if more
OTHER_VIEWS = f"other views, {100 * CONFIDENCE:.0f} %"  # what an interval is of, in words
TRAINING_VIEWS = 24  # at most, evenly spaced, that say how differences vary in a scene
# Differences of held-out views vary so many times as far as those of training views, whose variance
# counts as that of so many more held-out views: docs/experiments/evaluation.md.
_WIDER, _WORTH = 1.25, 5
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


def paired_difference(differences: Mapping[str, float], held_out: int) -> Difference:
    """The mean of differences (candidate minus baseline, larger is better) and its interval.

    Few views do not say how far views differ. Training views do: their mean is not that of unseen
    views, but their variance is close to it. And neighbours in the order of names show much the
    same. So what training views tell of their neighbours is subtracted from every difference (a
    control variate), and the interval is Student's, of the rest. It is a prediction: other views
    have an error of their own, so that whoever measures `OTHERS` more can tell whether it is right.

    Args:
        differences: by name of the view. The first `held_out` are of views that no result was
            trained on, the others of views that both were trained on.
        held_out: how many; at least one.

    Raises:
        ValueError: there are none, or one is not finite.
    """
    if not 0 < held_out <= len(differences) or not np.isfinite([*differences.values()]).all():
        raise ValueError("differences must be of one held-out view at least, all finite")
    values = np.array([*differences.values()])
    mean, trained = float(values[:held_out].mean()), len(values) - held_out
    if trained < 2:
        return Difference(mean, -math.inf, math.inf, held_out)
    slope, rest = _less_neighbours(differences, held_out)
    worth = min(_WORTH, trained - 1)
    freedom = held_out - 1 + worth

    def variance(x: NDArray[np.float64]) -> float:
        squares = worth * _WIDER**2 * x[held_out:].var(ddof=1)
        return float(squares + held_out * x[:held_out].var()) / freedom

    of_mean = variance(rest) * (1 / held_out + slope**2 / trained)
    half = half_width(of_mean + variance(values) / max(OTHERS, held_out), freedom)
    centre = float(rest[:held_out].mean() + slope * values[held_out:].mean())
    return Difference(mean, centre - half, centre + half, held_out)


def half_width(variance: float, freedom: int) -> float:
    """Of Student's interval of a mean, from its variance and the degrees of freedom of that."""
    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * math.sqrt(variance)


def _less_neighbours(
    differences: Mapping[str, float], held_out: int
) -> tuple[float, NDArray[np.float64]]:
    """How much of what training views tell of a neighbour is true, from 0 to 1, and each difference
    less that. A training view is told of by the others."""
    order = {name: float(place) for place, name in enumerate(sorted(differences))}
    at, values = np.array([(order[name], x) for name, x in differences.items()]).T
    trained = sorted(zip(at[held_out:], values[held_out:], strict=True))
    others = (np.array([pair for pair in trained if pair[0] != place]).T for place in at)
    neighbours = np.array([np.interp(place, *some) for place, some in zip(at, others, strict=True)])
    known, seen = neighbours[held_out:], values[held_out:]
    spread, covariance = known.var(), np.mean((known - known.mean()) * (seen - seen.mean()))
    slope = min(1.0, max(0.0, float(covariance / spread))) if spread else 0.0
    return slope, values - slope * neighbours
