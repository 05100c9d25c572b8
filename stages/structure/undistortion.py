"""Pinhole pictures from distorted ones (COLMAP's SIMPLE_RADIAL model)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST_GROWTH = 2.0  # of either side, as COLMAP caps it
_SMALLEST_SHARE = 0.2
_ROUNDS = 100


@dataclass(frozen=True)
class Pinhole:
    """An undistorted camera: pixels, pixel centres at +0.5, one focal length for both axes."""

    width: int
    height: int
    focal: float
    cx: float
    cy: float


def distort(uv: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    """[N, 2] distorted from undistorted image-plane coordinates: u (1 + k |u|^2)."""
    found: NDArray[np.float64] = uv * (1.0 + k * np.sum(uv**2, axis=-1, keepdims=True))
    return found


def undistort(uv: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    """[N, 2] inverse of `distort` on the part around the centre where it is monotonous; NaN
    beyond the largest radius that this lens model can show (k < 0)."""
    wanted = np.linalg.norm(uv, axis=-1)
    limit = np.inf if k >= 0 else 1.0 / np.sqrt(-3.0 * k)
    reachable = wanted <= 2.0 / 3.0 * limit  # k limit^2 = -1/3
    radius = np.minimum(wanted, limit)
    for _ in range(_ROUNDS):  # Newton on r + k r^3 = wanted, kept on the monotonous branch
        slope = np.maximum(1.0 + 3.0 * k * radius**2, 1e-9)
        radius = np.clip(radius - (radius + k * radius**3 - wanted) / slope, 0.0, limit)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(wanted > 0, radius / wanted, 1.0)
    return uv * np.where(reachable, ratio, np.nan)[..., None]


def pinhole_for(size: NDArray[np.integer], params: NDArray[np.float64]) -> Pinhole:
    """The camera with the same focal length whose picture is the largest rectangle that the
    photograph covers: no black borders.

    size [2] width, height; params [4] f, cx, cy, k.
    """
    width, height = int(size[0]), int(size[1])
    focal, cx, cy, k = (float(value) for value in params)
    left, top, right, bottom = _inner_rectangle(width, height, focal, cx, cy, k)
    left, right = max(left, -_LARGEST_GROWTH * cx), min(right, _LARGEST_GROWTH * (width - cx))
    top, bottom = max(top, -_LARGEST_GROWTH * cy), min(bottom, _LARGEST_GROWTH * (height - cy))
    if right - left < _SMALLEST_SHARE * width or bottom - top < _SMALLEST_SHARE * height:
        left, right, top, bottom = -cx, width - cx, -cy, height - cy
    # A hundredth of a pixel forgives rounding: without it k = 0 would lose a row and a column.
    return Pinhole(
        int(np.floor(right - left + 0.01)), int(np.floor(bottom - top + 0.01)), focal, -left, -top
    )


def _inner_rectangle(
    width: int, height: int, focal: float, cx: float, cy: float, k: float
) -> tuple[float, float, float, float]:
    """left, top, right, bottom in undistorted pixels, the principal point at 0."""
    x = np.linspace(0.0, width, 257)
    y = np.linspace(0.0, height, 257)

    def edge(
        xs: NDArray[np.float64] | float, ys: NDArray[np.float64] | float, axis: int
    ) -> NDArray[np.float64]:
        xy = np.stack(np.broadcast_arrays(xs, ys), axis=-1)
        return focal * undistort((xy - (cx, cy)) / focal, k)[:, axis]

    return (
        _extreme(np.nanmax, edge(0.0, y, 0), -np.inf),
        _extreme(np.nanmax, edge(x, 0.0, 1), -np.inf),
        _extreme(np.nanmin, edge(float(width), y, 0), np.inf),
        _extreme(np.nanmin, edge(x, float(height), 1), np.inf),
    )


def _extreme(choose: Callable[..., Any], values: NDArray[np.float64], otherwise: float) -> float:
    return float(choose(values)) if np.isfinite(values).any() else otherwise


def maps(pinhole: Pinhole, params: NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray]:
    """x and y [H, W] float32: where to look in the photograph, for cv2.remap (whose pixel centres
    are whole numbers)."""
    focal, cx, cy, k = (float(value) for value in params)
    u = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.focal
    v = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.focal
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    xy = focal * distort(uv, k) + (cx, cy) - 0.5
    return xy[..., 0].astype(np.float32), xy[..., 1].astype(np.float32)


def undistorted_px(
    xy: NDArray[np.float64], params: NDArray[np.float64], pinhole: Pinhole
) -> NDArray[np.float64]:
    """[N, 2] where photograph pixels `xy` lie in the undistorted picture (NaN if nowhere)."""
    focal, cx, cy, k = (float(value) for value in params)
    uv = undistort((xy - (cx, cy)) / focal, k)
    return pinhole.focal * uv + (pinhole.cx, pinhole.cy)
