"""Projection of points into the cells of a picture, and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera


def visible_points(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """(indices [K] of the points that project into the picture, pixels [K, 2], depths [K])."""
    pixels, z = camera.project(points)
    rows = np.flatnonzero((z > 0) & camera.shows(pixels))
    return rows, pixels[rows], z[rows]


def unproject(
    camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K, 3] the points at `depths` [K] that project to `pixels` [K, 2]."""
    rays = np.stack(
        [
            (pixels[:, 0] - camera.cx) / camera.fx,
            (pixels[:, 1] - camera.cy) / camera.fy,
            np.ones(len(pixels)),
        ],
        1,
    )
    at = rays * depths[:, None] - camera.world_to_camera[:3, 3]
    return np.asarray(at @ camera.world_to_camera[:3, :3], np.float64)


def cells(
    pixels: NDArray[np.float64], size: float = 1.0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(rows [K], columns [K]) of the cells of `size` pixels that contain `pixels` [K, 2]."""
    columns, rows = np.floor(pixels / size).astype(np.intp).T
    return rows, columns


def pixel_centres(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float64]:
    """[K, 2] the centre of each pixel."""
    return np.asarray(np.stack([columns, rows], 1) + 0.5, np.float64)
