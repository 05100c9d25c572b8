"""The measurements behind a trade-off report as values, and how its curves are read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.evaluate.coverage import Patches
from stages.evaluate.evaluation import Score
from stages.scene import Camera
from stages.tradeoff.intervals import Difference, paired_difference


@dataclass(frozen=True)
class HistoryPoint:
    """An evaluation during training: after `step` steps and so many seconds (time of evaluations
    included), the number of splats and the held-out PSNR."""

    step: int
    splats: int
    seconds: float
    cpu_seconds: float
    psnr_db: float


@dataclass(frozen=True)
class OperatingPoint:
    """One version of the scene.

    Args:
        label: in words.
        splats: how many.
        psnr_db: mean over the held-out views.
        change: of PSNR against the run's own splats.
        size_bytes: of the file; None where none was written.
    """

    label: str
    splats: int
    psnr_db: float
    change: Difference
    size_bytes: int | None = None


@dataclass(frozen=True)
class Coverage:
    """What the training views show.

    Args:
        names, cameras: of the training views that were examined, in the order of `patches`.
        patches: what they see.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    patches: Patches


@dataclass(frozen=True)
class Tradeoff:
    """All that was measured of a run.

    Args:
        own: the run's splats as they are.
        history: evaluations during training; empty where none was logged.
        formats: the same splats in each file format, smallest file first.
        pruned: fewer splats, fine-tuned after each removal, most first; `own` is the first.
        scores: of `own`, by held-out view.
        side_px: longer side of the pictures.
        coverage: what the training views show.
        exported: formats that the run wrote.
    """

    own: OperatingPoint
    history: tuple[HistoryPoint, ...]
    formats: tuple[OperatingPoint, ...]
    pruned: tuple[OperatingPoint, ...]
    scores: tuple[Score, ...]
    side_px: int
    coverage: Coverage
    exported: tuple[str, ...] = ()

    @property
    def worst(self) -> Score:
        return min(self.scores, key=lambda score: score.psnr_db)

    @property
    def knee(self) -> int:
        """Index in `pruned` of the knee of PSNR over the number of splats; 0 for none."""
        return knee([float(p.splats) for p in self.pruned], [p.psnr_db for p in self.pruned])


def mean_db(scores: Sequence[Score]) -> float:
    return float(np.mean([score.psnr_db for score in scores if score.counts]))


def change_of(
    scores: Sequence[Score], baseline: Sequence[Score], held_out: int, figure: str = "psnr_db"
) -> Difference:
    """Of one `figure` of the same views in the same order: so many held-out ones, then training
    views."""
    pairs = list(zip(scores, baseline, strict=True))
    unseen, seen = (
        [getattr(a, figure) - getattr(b, figure) for a, b in part if a.counts and b.counts]
        for part in (pairs[:held_out], pairs[held_out:])
    )
    return paired_difference(unseen, seen)


def time_to(history: Sequence[HistoryPoint], below_db: float) -> tuple[float, float]:
    """CPU seconds between which training came to within `below_db` of its last PSNR and stayed
    there: those of the evaluations before and after."""
    target = history[-1].psnr_db - below_db
    late = [i for i, point in enumerate(history) if point.psnr_db < target]
    first = late[-1] + 1 if late else 0
    return (history[first - 1].cpu_seconds if first else 0.0), history[first].cpu_seconds


def knee(costs: Sequence[float], psnr_db: Sequence[float]) -> int:
    """Index of the point farthest above the straight line from the cheapest to the dearest, over
    the logarithm of the cost: below it a doubling of the cost gains more PSNR than on average,
    above it less. The dearest point where none is above the line.

    Args:
        costs: positive.
        psnr_db: of each.
    """
    x, y = np.array([math.log2(cost) for cost in costs]), np.array(psnr_db)
    low, high = int(np.argmin(x)), int(np.argmax(x))
    span = x[high] - x[low]
    if span <= 0:
        return high
    above = y - (y[low] + (x - x[low]) / span * (y[high] - y[low]))
    best = int(np.argmax(above))
    return best if above[best] > 1e-9 else high
