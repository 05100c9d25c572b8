"""Stored figures of captures, presets and seeds, and whether one set of them is better."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.evaluation import SIZES
from stages.tradeoff.intervals import Difference, half_width


@dataclass(frozen=True)
class Cell:
    """One capture, preset and seed.

    Args:
        capture: its name.
        preset: that it was trained with.
        seed: of training.
        steps: of training.
        side: longer side of the full-size pictures, pixels.
        splats: that were left.
        cpu_seconds: of training, pruning and quantising; as `wall_seconds`.
        scores: of each view, by the name of the size, see `SIZES`.
    """

    capture: str
    preset: str
    seed: int
    steps: int
    side: int
    splats: int
    cpu_seconds: float
    wall_seconds: float
    scores: dict[str, list[dict[str, Any]]]

    def psnr_db(self, size: str) -> dict[str, float]:
        """By view, in the order of their names."""
        return {row["name"]: float(row["psnr_db"]) for row in sorted_rows(self.scores[size])}


def sorted_rows(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: str(row["name"]))


def grouped(cells: Iterable[Cell]) -> dict[tuple[str, str], list[Cell]]:
    """By preset and capture, in the order of seeds."""
    found: dict[tuple[str, str], list[Cell]] = {}
    for cell in sorted(cells, key=lambda cell: cell.seed):
        found.setdefault((cell.preset, cell.capture), []).append(cell)
    return found


def read(path: Path) -> list[Cell]:
    return [Cell(**cell) for cell in json.loads(path.read_text(encoding="utf-8"))]


def write(path: Path, cells: Iterable[Cell]) -> None:
    path.write_text(json.dumps([asdict(cell) for cell in cells], indent=1) + "\n", encoding="utf-8")


def verdicts(now: Sequence[Cell], before: Sequence[Cell]) -> Iterator[str]:
    """Lines: for each preset and size, each capture over views and seeds, then all captures over
    captures and seeds. What only one side has is left out."""
    earlier = grouped(before)
    gains: dict[tuple[str, str], dict[str, dict[int, float]]] = {}
    for (preset, capture), cells in grouped(now).items():
        seeds = {cell.seed: cell for cell in earlier.get((preset, capture), [])}
        pairs = [(cell, seeds[cell.seed]) for cell in cells if cell.seed in seeds]
        for size in SIZES:
            table = _gains_db(pairs, size)
            if not table:
                continue
            difference = difference_over(np.array(list(table.values())).T)
            yield f"{capture} {preset}, {size} size: {in_words(difference)}"
            means = {seed: float(np.mean(column)) for seed, column in table.items()}
            gains.setdefault((preset, size), {})[capture] = means
    for (preset, size), by_capture in gains.items():
        common = sorted(set.intersection(*map(set, by_capture.values())))
        if not common:
            continue
        means_db = [[means[seed] for seed in common] for means in by_capture.values()]
        over = f"{len(by_capture)} captures, {preset}, {size} size"
        yield f"{over}: {in_words(difference_over(np.array(means_db)))}"


def difference_over(table: NDArray[np.float64]) -> Difference:
    """The mean of `table` [views, seeds], and its interval over other views and, where there are
    several, other seeds: both have effects of their own, and those of the rarer say how sure the
    variance is. It has no ends for a single view."""
    views, mean = table.shape[0], float(table.mean())
    if views == 1:
        return Difference(mean, -math.inf, math.inf, views)
    means = [x for x in (table.mean(axis=1), table.mean(axis=0)) if len(x) > 1]
    variance = sum(float(x.var(ddof=1)) / len(x) for x in means)
    half = half_width(variance, min(len(x) for x in means) - 1)
    return Difference(mean, mean - half, mean + half, views)


def _gains_db(pairs: Sequence[tuple[Cell, Cell]], size: str) -> dict[int, list[float]]:
    """By seed, the gain of each view; empty where sizes, steps or views differ."""
    found = {}
    for a, b in pairs:
        if (a.side, a.steps) != (b.side, b.steps) or not {
            size
        } <= a.scores.keys() & b.scores.keys():
            continue
        one, other = a.psnr_db(size), b.psnr_db(size)
        if one.keys() == other.keys():
            found[a.seed] = [one[name] - other[name] for name in one]
    return found


def in_words(change: Difference) -> str:
    interval = f"{change.low:+.2f} to {change.high:+.2f}" if change.views > 1 else "one only"
    return f"{change.verdict}, {change.mean:+.2f} dB ({interval})"
