"""The ground plane (x and z of the world), partitioned into cells of equal weight of views.

The partition depends on what the views show, not on where the cameras are, so that no block lies
where no view looks, and a ring of cameras around an object is cut through the object. Each view
has a weight of one, which is spread over the points that it shows; all cells have about the same
total weight. Which views show which block is measured by rendering the coarse model of the whole
scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.contribution import blend_weights
from stages.scene import Camera, Reconstruction, Splats

UNBOUNDED = 1e30  # world units: the outer sides of the outer cells (JSON has no infinity)
MARGIN = 0.05  # of the scene's extent: how far beyond its own cell a block densifies
SIDE = 160  # longer side of the renderings of the coarse model, pixels
SMALLEST_FRACTION = 0.1  # of a picture that must show a block for the view to train it
_GROUND = [0, 2]  # the axes of the ground plane
_POINTS = 20_000  # about, of the sparse cloud
_EXTENT_PERCENTILES = (5, 95)


@dataclass(frozen=True)
class Cell:
    """A rectangle of the ground plane, of any height: low <= (x, z) < high."""

    low: tuple[float, float]
    high: tuple[float, float]

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] which of the points [N, 3] lie in it. Each point lies in one cell of a partition."""
        ground = points[:, _GROUND]
        return np.asarray(((ground >= self.low) & (ground < self.high)).all(1))

    def widened(self, by: float) -> Cell:
        """The cell, larger by `by` world units on each side."""
        low, high = np.array(self.low) - by, np.array(self.high) + by
        return Cell((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))

    def border_distance(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """[N] the distance of the points [N, 3] from the nearest of the four border lines, along
        that line's axis; world units."""
        ground = points[:, _GROUND].astype(np.float64)
        sides = np.concatenate([np.abs(ground - self.low), np.abs(ground - self.high)], axis=1)
        return np.asarray(sides.min(axis=1))


EVERYWHERE = Cell((-UNBOUNDED, -UNBOUNDED), (UNBOUNDED, UNBOUNDED))


def weighted_points(
    reconstruction: Reconstruction,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """([P, 2] x and z of the sparse points that views show, [P] weights: each view gives a total of
    one to the points that it shows). The camera centres with weight one if views show no points."""
    every = reconstruction.points
    points = every[:: max(1, len(every) // _POINTS)]
    weights = np.zeros(len(points))
    for view in reconstruction.views:
        pixels, z = view.camera.project(points)
        shown = (z > 0) & view.camera.shows(pixels)
        weights[shown] += 1.0 / max(1, int(shown.sum()))
    if weights.any():
        return points[weights > 0][:, _GROUND], weights[weights > 0]
    centres = np.array([view.camera.centre for view in reconstruction.views])[:, _GROUND]
    return centres, np.ones(len(centres))


def partition(
    places: NDArray[np.float64],
    weights: NDArray[np.float64],
    blocks: int,
    cell: Cell = EVERYWHERE,
) -> list[Cell]:
    """Cut `cell` into `blocks` cells that hold about the same total weight.

    Cuts recursively, along the axis on which the places extend farther. Returns fewer cells where
    places coincide and no line separates them.

    Args:
        places: [P, 2] x and z.
        weights: [P].
    """
    if blocks < 2 or len(places) < 2:
        return [cell]
    first = blocks // 2
    for axis in np.argsort(-_extent(places)):
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
            return partition(places[below], weights[below], first, lower) + partition(
                places[~below], weights[~below], blocks - first, upper
            )
    return [cell]


def _extent(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """[2] the distance between two percentiles along each axis."""
    low, high = np.percentile(places, _EXTENT_PERCENTILES, axis=0)
    return np.asarray(high - low)


def margin(places: NDArray[np.float64]) -> float:
    """`MARGIN` in world units, for the places [P, 2] that the views show."""
    return MARGIN * float(_extent(places).max())


def block_fractions(
    splats: Splats, cells: Sequence[Cell], cameras: Iterable[Camera], backend: str
) -> NDArray[np.float64]:
    """[blocks, cameras] the fraction of each picture that comes from splats in each cell, 0 to 1;
    occluded splats do not count. All 0 for a camera that sees nothing."""
    inside = [cell.holds(splats.means) for cell in cells]
    shares = []
    small = (camera.fitted(SIDE) for camera in cameras)
    for rows, weight in blend_weights(splats, small, backend):
        total = float(weight.sum())
        shares.append([float(weight[own[rows]].sum()) / total if total else 0.0 for own in inside])
    return np.array(shares).T.reshape(len(cells), -1)


def assign_views(fractions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[blocks, views] which views train which block, from `block_fractions`: each view trains the
    block that it shows most of, and all blocks that it shows enough of."""
    assigned = fractions >= SMALLEST_FRACTION
    most = fractions.argmax(axis=0)
    assigned[most, np.arange(fractions.shape[1])] |= fractions.max(axis=0) > 0
    return assigned


def crosses_blocks(assigned: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[views] which views show more than one block."""
    return np.asarray(assigned.sum(axis=0) > 1)
