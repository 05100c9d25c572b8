"""Undistorts cameras and pictures: from lenses with distortion to pinhole cameras.

The pinhole camera has the focal lengths of the photograph's camera; its picture is the largest
rectangle that the photograph covers, so it has no black borders (as COLMAP's image undistorter).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.cameras.lens import Lens
from stages.scene import Camera

_LARGEST_GROWTH = 2.0  # of either side, as COLMAP limits it
_SMALLEST_SHARE = 0.2  # of either side; below, the pinhole camera keeps the photograph's rectangle
WIDEST = np.tan(np.radians(60.0))  # beyond, a pinhole picture spends many pixels on little
_GRID = 33  # samples along either side, for the share of the photograph that stays visible
_NEWTON_STEPS = 100


class SimpleRadial(Lens):
    """COLMAP's SIMPLE_RADIAL: one radial term, whose inverse needs the radius only."""

    def undistort(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Lens`. NaN beyond the largest radius that this lens model can show (k < 0)."""
        (k,) = self.radial
        wanted = np.linalg.norm(seen, axis=-1)
        limit = np.inf if k >= 0 else 1.0 / np.sqrt(-3.0 * k)
        reachable = wanted <= 2.0 / 3.0 * limit  # k limit^2 = -1/3
        radius = np.minimum(wanted, limit)
        for _ in range(_NEWTON_STEPS):  # on r + k r^3 = wanted, kept on the monotonic branch
            slope = np.maximum(1.0 + 3.0 * k * radius**2, 1e-9)
            radius = np.clip(radius - (radius + k * radius**3 - wanted) / slope, 0.0, limit)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(wanted > 0, radius / wanted, 1.0)
        return seen * np.where(reachable, ratio, np.nan)[..., None]


def undistorted_camera(camera: Camera, lens: Lens) -> Camera:
    """The pinhole camera for a photograph's `camera` and its `lens`."""
    if not lens.distorts:
        return camera
    left, top, right, bottom = _inner_rectangle(camera, lens)
    # A hundredth of a pixel forgives rounding: without it k = 0 would lose a row and a column.
    width, height = int(right - left + 0.01), int(bottom - top + 0.01)
    return replace(camera, width=width, height=height, cx=-left, cy=-top)


def visible_share(camera: Camera, lens: Lens, pinhole: Camera) -> float:
    """The share of the photograph that its pinhole picture shows."""
    if not lens.distorts:
        return 1.0
    x, y = np.meshgrid(
        (np.arange(_GRID) + 0.5) * camera.width / _GRID,
        (np.arange(_GRID) + 0.5) * camera.height / _GRID,
    )
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    return float(pinhole.shows(undistorted_px(xy, camera, lens, pinhole)).mean())


def remap_tables(camera: Camera, lens: Lens, pinhole: Camera) -> tuple[np.ndarray, np.ndarray]:
    """x and y [H, W] float32: where each pixel of the pinhole picture lies in the photograph, for
    cv2.remap (whose pixel centres are whole numbers)."""
    u = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    v = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    uv = lens.distort(np.stack(np.meshgrid(u, v), axis=-1))
    x = camera.fx * uv[..., 0] + camera.cx - 0.5
    y = camera.fy * uv[..., 1] + camera.cy - 0.5
    return x.astype(np.float32), y.astype(np.float32)


def undistorted_px(
    xy: NDArray[np.float64], camera: Camera, lens: Lens, pinhole: Camera
) -> NDArray[np.float64]:
    """[N, 2] where photograph pixels `xy` lie in the pinhole picture (NaN if nowhere)."""
    px = _from_principal_point(xy, camera, lens)
    px += (pinhole.cx, pinhole.cy)
    return px


def _from_principal_point(
    xy: NDArray[np.float64], camera: Camera, lens: Lens
) -> NDArray[np.float64]:
    """[N, 2] undistorted pixels, relative to the principal point."""
    focal = np.array([camera.fx, camera.fy])
    return focal * lens.undistort((xy - (camera.cx, camera.cy)) / focal)


def _inner_rectangle(camera: Camera, lens: Lens) -> tuple[float, float, float, float]:
    """left, top, right, bottom relative to the principal point. An edge that no pinhole camera can
    show does not limit the rectangle."""
    samples, widest = (257, np.inf) if isinstance(lens, SimpleRadial) else (129, WIDEST)
    width, height = camera.width, camera.height
    x, y = np.linspace(0.0, width, samples), np.linspace(0.0, height, samples)

    def edge(
        xs: NDArray[np.float64] | float, ys: NDArray[np.float64] | float, axis: int
    ) -> NDArray[np.float64]:
        xy = np.stack(np.broadcast_arrays(xs, ys), axis=-1).astype(np.float64)
        found = _from_principal_point(xy, camera, lens)[:, axis]
        return found[np.isfinite(found)]

    def limit(side: float, focal: float) -> float:
        return float(min(_LARGEST_GROWTH * max(side, 1.0), focal * widest))

    left = max([-limit(camera.cx, camera.fx), *edge(0.0, y, 0)])
    right = min([limit(width - camera.cx, camera.fx), *edge(float(width), y, 0)])
    top = max([-limit(camera.cy, camera.fy), *edge(x, 0.0, 1)])
    bottom = min([limit(height - camera.cy, camera.fy), *edge(x, float(height), 1)])
    if right - left < _SMALLEST_SHARE * width or bottom - top < _SMALLEST_SHARE * height:
        return -camera.cx, -camera.cy, width - camera.cx, height - camera.cy
    return left, top, right, bottom
