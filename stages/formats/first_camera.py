"""The first camera as glTF and USD hold it: a pose, and a field of view around its centre.

Their cameras have x right, y up, and look along -z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera

NAME = "FirstView"
_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # between the axes of a `Camera` and theirs
_LONG_SIDE_PX = 960  # of what is read: these formats hold no pixels
_SKEW = 1e-4  # of a rotation that went through float32


def pose_of(camera: Camera) -> NDArray[np.float64]:
    """[4, 4] takes points of the camera, in their axes, to the world of `camera`."""
    return np.asarray(np.linalg.inv(camera.world_to_camera) @ _TURN)


def camera_of(pose: NDArray[np.floating], across: float, high: float) -> Camera | None:
    """The camera with a pose as `pose_of` returns it, which may be scaled, and a picture of this
    width and height at distance 1; None for what no perspective camera has."""
    if not (np.isfinite([across, high]).all() and across > 0 and high > 0):
        return None
    linear = np.asarray(pose, np.float64)[:3, :3]
    scale = np.cbrt(np.linalg.det(linear)) if np.isfinite(pose).all() else 0.0
    if not scale > 0 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > _SKEW:
        return None
    rigid = np.array(pose, np.float64)
    rigid[:3, :3] = linear / scale
    pixels = _LONG_SIDE_PX / max(across, high)
    width, height = max(1, round(across * pixels)), max(1, round(high * pixels))
    lens = width / across, height / high, width / 2, height / 2
    return Camera(width, height, *lens, _TURN @ np.linalg.inv(rigid))
