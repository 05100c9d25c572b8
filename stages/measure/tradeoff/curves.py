"""What was measured of a run, as plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.measure.bootstrap import Difference, paired_difference
from stages.measure.evaluation import Score

if TYPE_CHECKING:
    from stages.measure.tradeoff.thin import Thin


@dataclass(frozen=True)
class Moment:
    """Training after so many seconds (judging on the way included): splats, held-out PSNR."""

    step: int
    splats: int
    seconds: float
    cpu_seconds: float
    psnr_db: float


@dataclass(frozen=True)
class Point:
    """One way to have the scene. psnr_db: mean over the held-out photographs. change: of it,
    against the run's own splats. size_bytes: of the file; None where none was written. frame_s:
    seconds that a picture takes; None where nobody measured."""

    label: str
    splats: int
    psnr_db: float
    change: Difference
    size_bytes: int | None = None
    frame_s: float | None = None


@dataclass(frozen=True)
class Trade:
    """own: the run's splats as they are. moments: the course of training, () where none was
    logged. formats: the same splats in each file format. counts: fewer of them, not fine-tuned,
    most first, `own` among them. scores: of `own`, by photograph. side_px: longer side of the
    pictures. thin: where the capture is. exported: formats that the run wrote."""

    own: Point
    moments: tuple[Moment, ...]
    formats: tuple[Point, ...]
    counts: tuple[Point, ...]
    scores: tuple[Score, ...]
    side_px: int
    thin: Thin
    exported: tuple[str, ...] = ()

    @property
    def worst(self) -> Score:
        return min(self.scores, key=lambda score: score.psnr_db)


def mean_db(scores: Sequence[Score]) -> float:
    return float(np.mean([score.psnr_db for score in scores]))


def change_db(scores: Sequence[Score], against: Sequence[Score]) -> Difference:
    """Of PSNR, photograph by photograph."""
    pairs = zip(scores, against, strict=True)
    return paired_difference(np.array([a.psnr_db - b.psnr_db for a, b in pairs]))


def time_to(moments: Sequence[Moment], below_db: float, cpu: bool = False) -> tuple[float, float]:
    """(from, to) seconds between which training came to within `below_db` of its last figure, and
    stayed: it was judged at both ends, and not between."""
    wanted = moments[-1].psnr_db - below_db
    late = [i for i, moment in enumerate(moments) if moment.psnr_db < wanted]
    first = late[-1] + 1 if late else 0

    def at(i: int) -> float:
        return moments[i].cpu_seconds if cpu else moments[i].seconds

    return (at(first - 1) if first else 0.0), at(first)


def knee(costs: Sequence[float], psnr_db: Sequence[float]) -> int:
    """Which point lies farthest above the straight line from the cheapest to the dearest, over the
    logarithm of the cost: before it a doubling buys more than on the average, after it less.

    costs: positive. The dearest point where none lies above the line.
    """
    x, y = np.array([math.log2(cost) for cost in costs]), np.array(psnr_db)
    low, high = int(np.argmin(x)), int(np.argmax(x))
    span = x[high] - x[low]
    if span <= 0:
        return high
    above = y - (y[low] + (x - x[low]) / span * (y[high] - y[low]))
    best = int(np.argmax(above))
    return best if above[best] > 1e-9 else high
