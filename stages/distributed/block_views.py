"""Which photographs show which block: by what the coarse model of the whole puts into each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stages.distributed.partition import Cell
from stages.raster.backends import rasteriser_of
from stages.raster.definition import WEIGHT, splat_arrays
from stages.raster.draw import raster_settings_of
from stages.scene import Camera, Splats

SIDE = 160  # pixels, of the pictures that tell
LEAST = 0.1  # of a picture: a photograph that shows less of a block is none of its own


def shares(
    splats: Splats, cells: Sequence[Cell], cameras: Iterable[Camera], backend: str
) -> NDArray[np.float64]:
    """[blocks, cameras] how much of what each camera sees lies in each cell, 0 to 1; what hides
    behind something else does not count. All 0 for a camera that sees nothing."""
    rasteriser, arrays, settings = (
        rasteriser_of(backend),
        splat_arrays(splats),
        raster_settings_of(splats),
    )
    inside = [cell.holds(splats.means) for cell in cells]
    found = []
    for camera in cameras:
        small = camera.fitted(SIDE)
        forward = rasteriser.forward(arrays, small, settings)
        nothing = np.zeros((3, small.height, small.width), np.float32)
        weight = rasteriser.contributions(forward, nothing)[:, WEIGHT].astype(np.float64)
        rows, total = forward.visible, float(weight.sum())
        found.append([float(weight[own[rows]].sum()) / total if total else 0.0 for own in inside])
    return np.array(found).T.reshape(len(cells), -1)


def members(share: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[blocks, photographs] which photographs teach which block, by `shares`: those that show
    enough of it, and each at least that one of which it shows most."""
    chosen = share >= LEAST
    most = share.argmax(axis=0)
    chosen[most, np.arange(share.shape[1])] |= share.max(axis=0) > 0
    return chosen


def crossing(member: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[photographs] which show more than one block."""
    return np.asarray(member.sum(axis=0) > 1)
