"""The camera and the settings as the numbers that every backend's kernels read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import RasterSettings
from stages.scene import Camera

# Rotation (row by row) and translation from the world to the camera, then what the names say, and
# where the camera stands in the world.
R, T = 0, 9
FX, FY, CX, CY = 12, 13, 14, 15
LOW_X, HIGH_X, LOW_Y, HIGH_Y = 16, 17, 18, 19  # of the slopes x/z and y/z, beyond which J is frozen
NEAR, DILATION, ANTIALIAS = 20, 21, 22
CAMERA_CENTRE = 23  # 23:26
WIDTH, HEIGHT = 26, 27


def camera_row(camera: Camera, settings: RasterSettings) -> NDArray[np.float64]:
    """[28] as named above."""
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    limits = (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )
    return np.concatenate(
        [
            camera.world_to_camera[:3, :3].ravel(),
            camera.world_to_camera[:3, 3],
            (camera.fx, camera.fy, camera.cx, camera.cy),
            limits,
            (settings.near, settings.dilation_px2, float(settings.antialias)),
            camera.centre,
            (camera.width, camera.height),
        ]
    )
