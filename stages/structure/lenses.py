"""Pinhole pictures from those of any lens that `stages.cameras.lens` knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.cameras.lens import Lens
from stages.scene import Camera

_WIDEST = np.tan(np.radians(60.0))  # to each side: beyond, a pinhole shows little in many pixels
_LARGEST_GROWTH = 2.0  # of either side, as `undistort` caps it
_SMALLEST_SHARE = 0.2
_EDGE, _GRID = 129, 33  # samples


def straightened(camera: Camera, lens: Lens) -> tuple[Camera, float]:
    """(the pinhole camera with the same focal lengths whose picture is the largest rectangle that
    the photograph covers, the share of the photograph that is left in it)."""
    if not lens.bends:
        return camera, 1.0
    left, top, right, bottom = _inner_rectangle(camera, lens)
    width, height = int(right - left + 0.01), int(bottom - top + 0.01)
    pinhole = replace(camera, width=width, height=height, cx=-left, cy=-top)
    x, y = np.meshgrid(
        (np.arange(_GRID) + 0.5) * camera.width / _GRID,
        (np.arange(_GRID) + 0.5) * camera.height / _GRID,
    )
    seen = _straight(camera, lens, np.stack([x.ravel(), y.ravel()], axis=1))
    return pinhole, float(pinhole.shows(seen + np.array([pinhole.cx, pinhole.cy])).mean())


def maps(camera: Camera, lens: Lens, pinhole: Camera) -> tuple[np.ndarray, np.ndarray]:
    """x and y [H, W] float32 of the pinhole picture: where to look in the photograph, for cv2.remap
    (whose pixel centres are whole numbers)."""
    u = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    v = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    uv = lens.distort(np.stack(np.meshgrid(u, v), axis=-1))
    x = camera.fx * uv[..., 0] + camera.cx - 0.5
    y = camera.fy * uv[..., 1] + camera.cy - 0.5
    return x.astype(np.float32), y.astype(np.float32)


def _straight(camera: Camera, lens: Lens, px: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 2] pixels of a pinhole picture, counted from its principal point."""
    focal = np.array([camera.fx, camera.fy])
    return focal * lens.undistort((px - (camera.cx, camera.cy)) / focal)


def _inner_rectangle(camera: Camera, lens: Lens) -> tuple[float, float, float, float]:
    """left, top, right, bottom, counted from the principal point. Where no pinhole can show an
    edge, it does not bound."""
    width, height = camera.width, camera.height
    x, y = np.linspace(0.0, width, _EDGE), np.linspace(0.0, height, _EDGE)

    def edge(
        xs: NDArray[np.float64] | float, ys: NDArray[np.float64] | float, axis: int
    ) -> NDArray[np.float64]:
        xy = np.stack(np.broadcast_arrays(xs, ys), axis=-1).astype(np.float64)
        found = _straight(camera, lens, xy)[:, axis]
        return found[np.isfinite(found)]

    def within(side: float, focal: float) -> float:
        return float(min(_LARGEST_GROWTH * max(side, 1.0), focal * _WIDEST))

    left = max([-within(camera.cx, camera.fx), *edge(0.0, y, 0)])
    right = min([within(width - camera.cx, camera.fx), *edge(float(width), y, 0)])
    top = max([-within(camera.cy, camera.fy), *edge(x, 0.0, 1)])
    bottom = min([within(height - camera.cy, camera.fy), *edge(x, float(height), 1)])
    if right - left < _SMALLEST_SHARE * width or bottom - top < _SMALLEST_SHARE * height:
        return -camera.cx, -camera.cy, width - camera.cx, height - camera.cy
    return left, top, right, bottom
