"""Which points lie where given splats leave the pictures transparent: what an earlier run's
photographs did not show, and added ones do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.raster.draw import renderer
from stages.scene import Splats, View, evenly_spaced
from stages.seed.projection import cells, visible_points

_VIEWS, _SIDE = 100, 240  # at most: views that are drawn; pixels of each
_COVERED = 0.5  # alpha


def uncovered(
    splats: Splats, points: NDArray[np.float64], views: Sequence[View]
) -> NDArray[np.bool_]:
    """[P] the points that fewer than half of the views which show them show over given splats.

    Args:
        splats: given ones.
        points: [P, 3] in the frame of `splats.means`.
        views: training views.
    """
    draw = renderer(splats)
    shown, covered = np.zeros((2, len(points)), np.int64)
    for view in evenly_spaced(views, _VIEWS):
        camera = view.camera.fitted(_SIDE)
        rows, pixels, _ = visible_points(camera, points)
        shown[rows] += 1
        covered[rows] += draw(camera).alpha[cells(pixels)] >= _COVERED
    return np.asarray(2 * covered < shown)
