"""Cameras that frame splats, where there are no photographs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera, look_at
from stages.scene.quantiles import quantiles
from stages.scene.splats import Splats

_WIDTH_PX = 960
_MEANS_FOR_DEPTH = 4000
_SAMPLE = 100_000  # splats that choose where to look from
_LARGEST = 300.0  # logarithm of an area, so that it stays finite
_SIGMAS = 3.0  # of a usual splat in the smallest radius: a splat alone is seen from outside of it
_SIDES = 16  # directions that are tried
_HEIGHT = 0.3  # of the camera above the centre, as part of its level distance
_DISTANCE = 2.2  # in radii of the densest part
_CONE = 0.35  # half width of what must be free, as part of the distance
_FREE = 0.05  # part of that width's area that a side must be freer by
_LENS = 0.8  # focal length in widths
_NO_SIZE = 1e-3  # world units, for the size of a single point


def first_camera(splats: Splats) -> Camera:
    """The first camera that the splats come with; else one in front of them."""
    return splats.first_camera or front_camera(splats)


def front_camera(splats: Splats) -> Camera:
    """A camera a little above the densest part of the splats, near enough to be inside a room
    around it, on the side where least lies between; in front (-z) if several sides are free."""
    means, sizes, least = _sampled(splats)
    centre, radius = _densest_part(means)
    radius = max(radius, least) or _NO_SIZE
    distance = _DISTANCE * radius
    best, direction = np.inf, np.zeros(3)
    for angle in 2 * np.pi * np.arange(_SIDES) / _SIDES:
        tried = np.array([np.sin(angle), -_HEIGHT, -np.cos(angle)]) / np.hypot(1, _HEIGHT)
        along = (means - centre) @ tried
        aside = np.linalg.norm(means - centre - along[:, None] * tried, axis=1)
        between = (along > radius) & (along < 1.2 * distance) & (aside < _CONE * along)
        covered = float(sizes[between].sum()) / (_CONE * distance) ** 2
        if covered < best - _FREE:
            best, direction = covered, tried
    eye = centre + distance * direction
    width, height = _WIDTH_PX, _WIDTH_PX * 3 // 4
    lens = (_LENS * width, _LENS * width, width / 2, height / 2)
    return Camera(width, height, *lens, look_at(eye, centre))


def _sampled(splats: Splats) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(means [M, 3], area times opacity [M], the smallest radius of a part) of at most _SAMPLE
    splats that can be drawn. The radius is _SIGMAS of the median splat; 0 if there is none."""
    step = max(1, len(splats) // _SAMPLE)
    means = splats.means[::step].astype(np.float64)
    scales = splats.log_scales[::step].max(axis=1, initial=-np.inf).astype(np.float64)
    scales = np.minimum(scales, _LARGEST / 2)
    areas = np.exp(2 * scales) * splats.opacities[::step]
    drawable = np.isfinite(means).all(axis=1) & np.isfinite(areas)
    least = _SIGMAS * float(np.exp(np.median(scales[drawable]))) if drawable.any() else 0.0
    return means[drawable], areas[drawable], least


def _densest_part(means: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """(centre [3], radius) of a ball that holds a third of the means: the median of those nearest
    to the median, of fewer and fewer."""
    if not len(means):
        return np.zeros(3), 0.0
    centre = np.median(means, axis=0)
    for share in (0.8, 0.6, 0.45, 1 / 3):
        away = np.linalg.norm(means - centre, axis=1)
        centre = np.median(means[away <= np.quantile(away, share)], axis=0)
    away = np.linalg.norm(means - centre, axis=1)
    return centre, float(np.quantile(away, 1 / 3))


def orbit_cameras(splats: Splats, count: int, part: float) -> tuple[Camera, ...]:
    """`count` cameras evenly around the middle `part` (0 to 1) of the splats along each axis. The
    first is in front; each sees all of that part."""
    low, high = quantiles(splats.means, (0.5 - part / 2, 0.5 + part / 2))
    middle = (low + high) / 2
    least = 2 * _sampled(splats)[2]
    distance = (max(float(np.linalg.norm(high - low)), least) or _NO_SIZE) * 1.2
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
    ahead = z > 0
    inside = ahead & camera.shows(pixels)
    for chosen in (inside, ahead):
        if chosen.any():
            return float(np.median(z[chosen]))
    return 1.0
