"""The ground plane (x and z of the world) cut into rectangles of about equal photographs.

It is cut by what photographs look at, not by where they were taken: no block lies where nobody
looks, and a ring of cameras around an object is cut through the object. About equal means that the
shares of photographs that fall into each rectangle add up to the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene import Reconstruction

ENDLESS = 1e30  # world units: the outer sides of the outer cells (JSON has no infinity)
MARGIN = 0.05  # of what photographs look at: as far beyond its own cell a block grows
_GROUND = [0, 2]
_POINTS = 20_000  # of the sparse cloud, about: enough to say where to cut
_MIDDLE_PERCENT = (5, 95)


@dataclass(frozen=True)
class Cell:
    """A rectangle of the ground plane, of any height: low <= (x, z) < high."""

    low: tuple[float, float]
    high: tuple[float, float]

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] which of the points [N, 3] lie in it. Each point lies in one cell of a cut."""
        at = points[:, _GROUND]
        return np.asarray(((at >= self.low) & (at < self.high)).all(1))

    def widened(self, by: float) -> Cell:
        """With a border of `by` world units."""
        low, high = np.array(self.low) - by, np.array(self.high) + by
        return Cell((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))

    def from_border(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """[N] how far the points [N, 3] are from the border to another cell, inside or outside
        along the axis in question; world units."""
        at = points[:, _GROUND].astype(np.float64)
        sides = np.concatenate([np.abs(at - self.low), np.abs(at - self.high)], axis=1)
        found: NDArray[np.float64] = sides.min(axis=1)
        return found


EVERYWHERE = Cell((-ENDLESS, -ENDLESS), (ENDLESS, ENDLESS))


def looked_at(reconstruction: Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """([P, 2] x and z of points that photographs show, [P] how many photographs look there: each
    photograph counts one, shared by what it shows). The cameras' own places if they show none."""
    every = reconstruction.points
    points = every[:: max(1, len(every) // _POINTS)]
    weights = np.zeros(len(points))
    for view in reconstruction.views:
        pixels, z = view.camera.project(points)
        shown = (z > 0) & view.camera.shows(pixels)
        weights[shown] += 1.0 / max(1, int(shown.sum()))
    if weights.any():
        return points[weights > 0][:, _GROUND], weights[weights > 0]
    places = np.array([view.camera.centre for view in reconstruction.views])[:, _GROUND]
    return places, np.ones(len(places))


def cut(
    places: NDArray[np.float64],
    weights: NDArray[np.float64],
    blocks: int,
    cell: Cell = EVERYWHERE,
) -> list[Cell]:
    """As many cells, with about as much of the weights [P] of the places [P, 2] in each; together
    they are `cell`.

    What is cut is cut again, along the axis on which its places spread farther. Fewer cells where
    places coincide and no line parts them.
    """
    if blocks < 2 or len(places) < 2:
        return [cell]
    first = blocks // 2
    for axis in np.argsort(-_spread(places)):
        order = np.argsort(places[:, axis], kind="stable")
        sums, at = np.cumsum(weights[order]), places[order, axis]
        row = int(np.searchsorted(sums, sums[-1] * first / blocks))
        row = min(max(0, row), len(places) - 2)
        line = float((at[row] + at[row + 1]) / 2)
        below = places[:, axis] < line
        if below.any() and not below.all():
            high, low = list(cell.high), list(cell.low)
            high[axis] = low[axis] = line
            lower = Cell(cell.low, (high[0], high[1]))
            upper = Cell((low[0], low[1]), cell.high)
            return cut(places[below], weights[below], first, lower) + cut(
                places[~below], weights[~below], blocks - first, upper
            )
    return [cell]


def _spread(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """[2] of the middle of the places, along each axis."""
    low, high = np.percentile(places, _MIDDLE_PERCENT, axis=0)
    found: NDArray[np.float64] = high - low
    return found


def margin(places: NDArray[np.float64]) -> float:
    """`MARGIN` in world units, for a scene whose photographs look at `places` [P, 2]."""
    return MARGIN * float(_spread(places).max())
