"""What hangs in the open air: before surfaces that the start knows, where hardly anybody looks.

Growth creeps out of what stands near by. Where many photographs look, the others pull it back; at
the rims of three or four, nothing does, and a handful of splats dresses in what those photographs
show behind it. They lose nothing by it, and the next view past them looks into a cloud. The start
remembers better: its points were confirmed by several photographs before anything grew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.backends import rasteriser_of
from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import Camera, Splats

SIDE = 160  # pixels: of the pictures of depth
WIDER = 1.5  # seeds are drawn that much larger, so that none behind shows between them
SOLID = 4.0  # opacity's logit of a seed that hides what is behind
AROUND = 2  # pixels: the nearest depth within counts, since rims are not where they seem
BEFORE = 0.5  # of the depth: nearer than that is before the surface
BEHIND = 1.15  # of the depth: farther than that, a photograph cannot see it
ENOUGH = 4  # photographs that look past it: they would have contradicted what is not there


@dataclass(frozen=True)
class OpenAir:
    """cameras: of the photographs in training, SIDE pixels long. depths: of what the start has
    before each, [H, W], world units; infinite where it has nothing."""

    cameras: tuple[Camera, ...]
    depths: tuple[NDArray[np.float32], ...]

    def holds(self, means: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] which of these places [N, 3] at least one and fewer than ENOUGH photographs look
        past, at something twice as far away, while none has a surface there."""
        passed = np.zeros(len(means), np.int32)
        open_still = np.flatnonzero(np.isfinite(means).all(1))
        for camera, depths in zip(self.cameras, self.depths, strict=True):
            if not len(open_still):
                break
            pixels, z = camera.project(means[open_still])
            rows = np.flatnonzero((z > 0) & camera.shows(pixels))
            x, y = pixels[rows].astype(np.intp).T
            of_depth = z[rows] / depths[y, x]
            before = of_depth < BEFORE
            passed[open_still[rows[before & np.isfinite(depths[y, x])]]] += 1
            here = rows[~before & (of_depth <= BEHIND)]
            passed[open_still[here]] = ENOUGH
            open_still = open_still[passed[open_still] < ENOUGH]
        return (passed > 0) & (passed < ENOUGH)


def open_air(start: Splats, cameras: Sequence[Camera], near: float, backend: str) -> OpenAir:
    """As `start` knows it. near: of the cameras, world units. backend: what draws."""
    from scipy.ndimage import minimum_filter

    rasteriser = rasteriser_of(backend)
    solid = replace(
        start.with_sh_degree(0),
        opacity_logits=np.full(len(start), SOLID, np.float32),
        log_scales=start.log_scales + np.float32(np.log(WIDER)),
    )
    small, depths = [], []
    for camera in cameras:
        small.append(camera.fitted(SIDE))
        settings = RasterSettings(near=near, sh_degree=0)
        drawn = rasteriser.forward(splat_arrays(solid), small[-1], settings, depths=True).image
        median = np.where(drawn[3] > 0.5, drawn[5], np.inf).astype(np.float32)
        depths.append(minimum_filter(median, 2 * AROUND + 1, mode="nearest"))
    return OpenAir(tuple(small), tuple(depths))
