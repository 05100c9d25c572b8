"""Removes floaters that appear during training: splats in space that the seeds show to be free.

Densification can leave splats far in front of surfaces. Where many views look, their gradients move
or fade such splats. Where only two or three look, a few splats near the cameras can reproduce what
these views show behind them: the training loss does not rise, but other views see a cloud. Seeds do
not lie there, because views agree on their depths, or one view estimated them. So a splat is a
floater if few views look past it at seeds that lie at least twice as far away (`NEAR`), and no view
has seeds at its depth (`FAR`). Positions are [N, 3], depths are along the optical axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from stages.scene import Camera

CELLS = 32  # along the longer side of a view; about as dense as the seeds
NEAR = 0.5  # of the seeds' depth: a splat nearer than that is in front of the surface
FAR = 1.15  # of the seeds' depth: a splat farther than that is hidden from the view
MIN_VIEWS_PAST = 2  # views that look past a floater: the depth of a single view may be wrong
# So many views would have corrected a floater, so what they look past is real.
ENOUGH_VIEWS_PAST = 4


@dataclass(frozen=True)
class FreeSpace:
    """The space that the seeds show to be free.

    Args:
        cameras: of the training views, with one pixel for each cell.
        depths: for each camera [H, W], the smallest depth of a seed in a cell and its neighbours,
            in world units; infinite where there is none.
    """

    cameras: tuple[Camera, ...]
    depths: tuple[NDArray[np.float64], ...]

    def contains(self, means: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] which of the positions [N, 3] are in free space: at least
        MIN_VIEWS_PAST and fewer than ENOUGH_VIEWS_PAST views see a surface at more than twice their
        depth, and no view sees one there."""
        views_past = np.zeros(len(means), np.int32)
        open_rows = np.flatnonzero(np.isfinite(means).all(1))
        for camera, depths in zip(self.cameras, self.depths, strict=True):
            rows, relative = _relative_depths(camera, depths, means[open_rows])
            in_front = relative < NEAR
            views_past[open_rows[rows[in_front]]] += 1
            views_past[open_rows[rows[~in_front & (relative <= FAR)]]] = ENOUGH_VIEWS_PAST
            open_rows = open_rows[views_past[open_rows] < ENOUGH_VIEWS_PAST]
        return (views_past >= MIN_VIEWS_PAST) & (views_past < ENOUGH_VIEWS_PAST)


def known_free_space(seeds: NDArray[np.floating], cameras: Sequence[Camera]) -> FreeSpace:
    """The free space of seeds at positions [N, 3], as seen by the training views."""
    seeds = seeds[np.isfinite(seeds).all(1)]
    cells = tuple(camera.fitted(CELLS) for camera in cameras)
    depths = []
    for camera in cells:
        pixels, z = camera.project(seeds)
        rows = np.flatnonzero((z > 0) & camera.shows(pixels))
        x, y = pixels[rows].astype(np.intp).T
        nearest = np.full((camera.height, camera.width), np.inf)
        np.minimum.at(nearest, (y, x), z[rows])
        depths.append(minimum_filter(nearest, 3, mode="nearest"))
    return FreeSpace(cells, tuple(depths))


def _relative_depths(
    camera: Camera, depths: NDArray[np.float64], means: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """(rows [K] of the positions that the camera shows where the seeds' depth is known, their
    depths as multiples of it [K])."""
    pixels, z = camera.project(means)
    rows = np.flatnonzero((z > 0) & camera.shows(pixels))
    x, y = pixels[rows].astype(np.intp).T
    known = np.isfinite(depths[y, x])
    return rows[known], z[rows[known]] / depths[y[known], x[known]]
