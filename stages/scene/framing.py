"""Cameras that frame splats, where there are no photographs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera, look_at
from stages.scene.quantiles import quantiles
from stages.scene.splats import Splats

_WIDTH_PX = 960
_MEANS_FOR_DEPTH = 4000


def front_camera(splats: Splats) -> Camera:
    """A camera that sees the middle nine tenths of the splats, from -z and a little above."""
    return orbit_cameras(splats, 1, 0.9)[0]


def orbit_cameras(splats: Splats, count: int, part: float) -> tuple[Camera, ...]:
    """`count` cameras evenly around the middle `part` (0 to 1) of the splats along each axis. The
    first is in front; each sees all of that part."""
    low, high = quantiles(splats.means, (0.5 - part / 2, 0.5 + part / 2))
    middle = (low + high) / 2
    distance = max(float(np.linalg.norm(high - low)), 1e-3) * 1.2
    width = _WIDTH_PX
    height = width * 3 // 4
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = middle + distance * np.array([np.sin(angle), -0.3, -np.cos(angle)])
        pose = look_at(eye, middle)
        cameras.append(Camera(width, height, width, width, width / 2, height / 2, pose))
    return tuple(cameras)


def median_depth(camera: Camera, means: NDArray[np.floating]) -> float:
    """The median z of the means inside the picture; of all in front of the camera if none is."""
    points = means[:: max(1, len(means) // _MEANS_FOR_DEPTH)].astype(np.float64)
    pixels, z = camera.project(points)
    ahead = z > 0.01
    inside = ahead & camera.shows(pixels)
    for chosen in (inside, ahead):
        if chosen.any():
            return float(np.median(z[chosen]))
    return 1.0
