"""The camera and the settings as one row of numbers, as the kernels of every backend read them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import RasterSettings
from stages.scene import Camera

# Columns of the row: rotation (row by row) and translation from the world to the camera, and so on.
R, T = 0, 9
FX, FY, CX, CY = 12, 13, 14, 15
LOW_X, HIGH_X, LOW_Y, HIGH_Y = 16, 17, 18, 19  # limits of x/z and y/z in the Jacobian J
NEAR, DILATION, ANTIALIAS = 20, 21, 22
CAMERA_CENTRE = 23  # 23:26, the camera's centre in the world
WIDTH, HEIGHT = 26, 27


def clamp_limits(camera: Camera) -> tuple[float, float, float, float]:
    """Range of x/z and of y/z outside which the affine approximation is frozen: the picture's own
    range and 0.3 of the half field of view on each side (the reference trainer's 1.3)."""
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    return (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


def camera_row(camera: Camera, settings: RasterSettings) -> NDArray[np.float64]:
    """[28] numbers of a camera and its settings, at the indices that the comments above name."""
    return np.concatenate(
        [
            camera.world_to_camera[:3, :3].ravel(),
            camera.world_to_camera[:3, 3],
            (camera.fx, camera.fy, camera.cx, camera.cy),
            clamp_limits(camera),
            (settings.near, settings.dilation_px2, float(settings.antialias)),
            camera.centre,
            (camera.width, camera.height),
        ]
    )
