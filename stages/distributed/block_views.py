"""Which views show which block, measured by rendering the coarse model of the whole scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stages.distributed.partition import Cell
from stages.measure.contribution import blend_weights
from stages.scene import Camera, Splats

SIDE = 160  # longer side of the renderings, pixels
SMALLEST_FRACTION = 0.1  # of a picture that must show a block for the view to train it


def block_fractions(
    splats: Splats, cells: Sequence[Cell], cameras: Iterable[Camera], backend: str
) -> NDArray[np.float64]:
    """[blocks, cameras] the fraction of each picture that comes from splats in each cell, 0 to 1;
    occluded splats do not count. All 0 for a camera that sees nothing."""
    inside = [cell.holds(splats.means) for cell in cells]
    found = []
    small = (camera.fitted(SIDE) for camera in cameras)
    for rows, weight in blend_weights(splats, small, backend):
        total = float(weight.sum())
        found.append([float(weight[own[rows]].sum()) / total if total else 0.0 for own in inside])
    return np.array(found).T.reshape(len(cells), -1)


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
