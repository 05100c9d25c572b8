"""An orbit around the scene: a path of cameras with the same intrinsics. The world is y down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, Splats, look_at
from stages.scene.framing import median_depth

_STEEPEST_DEG = 80.0  # elevation; from straight above, left and right are undefined
_INSIDE = 0.9  # of an arc: its ends are seen by a single view only
_SPREAD_RAD = np.radians(20.0)  # of the weights of cameras around the direction of a frame


def orbit(cameras: Sequence[Camera], splats: Splats, frames: int) -> tuple[Camera, ...]:
    """A turn around what `cameras` look at, at the distance and elevation of the cameras that look
    from there: where they stood nearer because of a wall, so does the path.

    If the cameras leave out much of the turn, the path goes to and fro over the arc that they
    cover. It is a loop: the frame after the last equals the first.
    """
    middle = focus(cameras, splats)
    start, half = arc_seen(cameras, splats)
    phase = 2 * np.pi * np.arange(frames) / frames
    angles = start + (phase if half >= np.pi else half * np.sin(phase))
    lens = common_lens(cameras)
    made = []
    for angle, (distance, height) in zip(angles, _stands(cameras, middle, angles), strict=True):
        ray = (np.cos(height) * np.sin(angle), -np.sin(height), np.cos(height) * np.cos(angle))
        eye = middle + distance * np.array(ray)
        made.append(replace(lens, world_to_camera=look_at(eye, middle)))
    return tuple(made)


def _stands(
    cameras: Sequence[Camera], middle: NDArray[np.float64], angles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[F, 2] the distance from `middle` and the elevation (radians) of the cameras in the
    directions `angles` [F]: means that are weighted by von Mises distributions around these."""
    away = np.array([camera.centre for camera in cameras]) - middle
    distances = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
    limit = np.radians(_STEEPEST_DEG)
    heights = np.arctan2(-away[:, 1], np.hypot(away[:, 0], away[:, 2])).clip(-limit, limit)
    apart = angles[:, None] - np.arctan2(away[:, 0], away[:, 2])
    weights = np.exp((np.cos(apart) - 1.0) / _SPREAD_RAD**2)
    weights /= weights.sum(1, keepdims=True)
    found: NDArray[np.float64] = weights @ np.stack([distances, heights], axis=1)
    return found


def arc_seen(cameras: Sequence[Camera], splats: Splats) -> tuple[float, float]:
    """(centre, half width) of the arc that the cameras cover, radians from +z towards +x. The whole
    turn, starting at the first camera, if the widest gap is less than a third of it, or if there
    is one camera."""
    away = np.array([camera.centre for camera in cameras]) - focus(cameras, splats)
    angles = np.arctan2(away[:, 0], away[:, 2])
    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if len(cameras) == 1 or gaps[widest] < 2 * np.pi / 3:
        return float(angles[0]), np.pi
    half = (2 * np.pi - gaps[widest]) / 2
    return float(ordered[(widest + 1) % len(ordered)] + half), float(_INSIDE * half)


def focus(cameras: Sequence[Camera], splats: Splats) -> NDArray[np.float64]:
    """[3] the point nearest to the cameras' axes (least squares) if most cameras look towards it,
    else the median of the points at each camera's median depth on its axis."""
    centres = np.array([camera.centre for camera in cameras])
    ahead = np.array([camera.forward for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    normal = across.sum(0)
    if np.linalg.cond(normal) < 1e4:
        point = np.linalg.solve(normal, np.einsum("vij,vj->i", across, centres))
        if np.mean(np.einsum("vi,vi->v", point - centres, ahead) > 0) > 0.5:
            return np.asarray(point)
    depths = [median_depth(camera, splats.means) for camera in cameras]
    return np.asarray(np.median(centres + np.array(depths)[:, None] * ahead, axis=0))


def common_lens(cameras: Sequence[Camera]) -> Camera:
    """A camera with the most frequent picture size, the median focal lengths of that size, and the
    principal point in the centre."""
    sizes = [(camera.width, camera.height) for camera in cameras]
    width, height = max(sizes, key=sizes.count)
    alike = [c for c, size in zip(cameras, sizes, strict=True) if size == (width, height)]
    fx, fy = (float(np.median([getattr(c, name) for c in alike])) for name in ("fx", "fy"))
    return Camera(width, height, fx, fy, width / 2, height / 2, np.eye(4))
