"""What hangs in the open air: before surfaces that the start knows, where hardly anybody looks.

Growth creeps out of what stands near by. Where many photographs look, the others pull it back; at
the rims of three or four, nothing does, and a handful of splats dresses in what those photographs
show behind it. They lose nothing by it, and the next view past them looks into a cloud. The start
remembers better: its points lie where photographs agree, or as far back as one of them sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera

CELLS = 32  # along the longer side of a photograph, as the start fills it
BEFORE = 0.5  # of the depth: nearer than that is before the surface
BEHIND = 1.15  # of the depth: farther than that, a photograph cannot see it
WITNESSES = 2  # photographs that look past it: where few look at all, one depth is a guess
ENOUGH = 4  # photographs that look past it: they would have contradicted what is not there


@dataclass(frozen=True)
class FreeSpace:
    """cameras: of the photographs in training, a pixel for each cell. depths: of the nearest that
    the start has in each cell and those around it, [H, W], world units; infinite where it has
    nothing."""

    cameras: tuple[Camera, ...]
    depths: tuple[NDArray[np.float64], ...]

    def contains(self, means: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] which of these places [N, 3] at least WITNESSES and fewer than ENOUGH photographs
        look past, at something twice as far away, while none has a surface there."""
        passed = np.zeros(len(means), np.int32)
        asked = np.flatnonzero(np.isfinite(means).all(1))
        for camera, depths in zip(self.cameras, self.depths, strict=True):
            rows, of_depth = _of_depth(camera, depths, means[asked])
            before = of_depth < BEFORE
            passed[asked[rows[before]]] += 1
            passed[asked[rows[~before & (of_depth <= BEHIND)]]] = ENOUGH
            asked = asked[passed[asked] < ENOUGH]
        return (passed >= WITNESSES) & (passed < ENOUGH)


def known_free_space(start: NDArray[np.floating], cameras: Sequence[Camera]) -> FreeSpace:
    """As the start knows it, which has something at these places [N, 3]."""
    from scipy.ndimage import minimum_filter

    start = start[np.isfinite(start).all(1)]
    cells = tuple(camera.fitted(CELLS) for camera in cameras)
    depths = []
    for camera in cells:
        pixels, z = camera.project(start)
        rows = np.flatnonzero((z > 0) & camera.shows(pixels))
        x, y = pixels[rows].astype(np.intp).T
        nearest = np.full((camera.height, camera.width), np.inf)
        np.minimum.at(nearest, (y, x), z[rows])
        depths.append(minimum_filter(nearest, 3, mode="nearest"))
    return FreeSpace(cells, tuple(depths))


def _of_depth(
    camera: Camera, depths: NDArray[np.float64], means: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """(rows [K] of the places that the camera shows before or behind something known, how far away
    they are [K], of that something's depth)."""
    pixels, z = camera.project(means)
    rows = np.flatnonzero((z > 0) & camera.shows(pixels))
    x, y = pixels[rows].astype(np.intp).T
    known = np.isfinite(depths[y, x])
    return rows[known], z[rows[known]] / depths[y[known], x[known]]
