"""Finds the image circle of a fisheye lens: outside it, all photographs are as dark as in their
corners."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera

LOOKED_AT = 12  # photographs, evenly spaced
_SIDE = 512  # pixels of the longer side, at which they are compared
_BLACKEST = 40  # of 255: black of a sensor, and light that the lens scatters, in every channel
_DARK = 12  # of 255 above that black
_CORNERS = 0.01  # of the picture: the least that is dark
_DARK_SHARE = 0.9  # of the pixels beyond the circle; scattered light is not
_RIM = 0.3  # of the pixels on a ring: what no ring beyond the circle has
_LEAST_LIT = 0.5  # of the pixels on the rings just within it; the rest shows dark things
_LIT_SHARE = 0.95  # of that share: what the last ring within it has at least
_FEWEST = 32  # pixels of a ring; the outermost rings are a few pixels in the corners
_WITHIN = 0.9  # of the rim's radius: from where on rings say how much is lit
_MARGIN = 0.01  # of the radius, for the blurred rim


def brightest(pictures: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """[h, w] the largest value of each pixel over all channels of one or more pictures [H, W, 3],
    scaled down."""
    small = [_reduced(picture) for picture in pictures]
    return np.asarray(np.max(small, axis=0), np.uint8)


def circle_radius(lit: NDArray[np.uint8], camera: Camera) -> float:
    """The radius of the image circle around the principal point, in pixels of the photographs;
    infinite where there is none.

    Args:
        lit: of photographs of one camera, see `brightest`.
        camera: theirs.
    """
    height, width = lit.shape
    small = camera.resized(width, height)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    away = np.hypot(x - small.cx, y - small.cy)
    black = np.median(lit[away >= np.quantile(away, 1.0 - _CORNERS)])
    shown = lit > black + _DARK
    rings = away.astype(np.int64)
    counts = np.bincount(rings.ravel())
    share = np.bincount(rings.ravel(), shown.ravel()) / np.maximum(counts, _FEWEST)
    rim = int(np.flatnonzero(share >= _RIM).max(initial=0))
    usual = np.median(share[int(_WITHIN * rim) : rim + 1])
    beyond = away > rim + 2
    if black > _BLACKEST or usual < _LEAST_LIT or beyond.mean() < _CORNERS:
        return float("inf")
    if (~shown[beyond]).mean() < _DARK_SHARE:
        return float("inf")
    full = np.flatnonzero(share[: rim + 1] >= _LIT_SHARE * usual)
    return float(full[-1] * (1.0 - _MARGIN) * camera.width / width)


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    scale = min(1.0, _SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA).max(axis=-1))
