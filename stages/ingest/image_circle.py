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
_LARGE = 0.8  # of half the shorter side: the least radius where the lens is not known
_SAME = 0.03  # by which its radius may differ between photographs
_BRIGHT = 2 * _DARK  # what is seen just within such a circle, above black
_FALL = 0.5  # of what is seen further within; the light of a torch or a flash falls off more
_FURTHER = 0.7, 0.85  # x its radius
_JUST_BEYOND = 1.08, 1.15  # x its radius, as it may lie beside the middle: all dark
_REACH = 0.9  # of the radius, or of the picture: up, down or sideways; black bars leave less
_LINE = 0.05  # of a row or column: the least that is lit there


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


def always_same_circle(pictures: Iterable[NDArray[np.uint8]]) -> bool:
    """Whether most pictures [H, W, 3] show one image circle. The lens need not be known.

    An object before black is smaller, or of another size in each picture.
    """
    radii = np.array([_large_circle(brightest([picture])) for picture in pictures])
    found = radii[np.isfinite(radii)]
    if not len(found):
        return False
    same = np.abs(found / np.median(found) - 1.0) <= _SAME
    return bool(2 * same.sum() > len(radii))


def _large_circle(lit: NDArray[np.uint8]) -> float:
    """The radius around the middle, over the longer side, of a circle that is large and bright up
    to its rim; infinite where there is none. lit: see `brightest`."""
    height, width = lit.shape
    middle = Camera(width, height, 1.0, 1.0, width / 2, height / 2, np.eye(4))
    radius = circle_radius(lit, middle)
    if not 0.5 * _LARGE * min(height, width) <= radius < np.inf:
        return float("inf")
    x, y = np.arange(width) + 0.5 - middle.cx, np.arange(height) + 0.5 - middle.cy
    away = np.hypot(x, y[:, None]) / radius
    further, within, beyond = (
        lit[(away > nearest) & (away < farthest)].astype(np.float64)
        for nearest, farthest in (_FURTHER, (_WITHIN, 1.0 - _SAME), _JUST_BEYOND)
    )
    if not len(beyond):
        return float("inf")
    black = np.median(beyond)
    rim = np.median(within) - black
    bright = rim > max(_BRIGHT, _FALL * (np.median(further) - black))
    dark = (beyond <= black + _DARK).mean() >= _DARK_SHARE
    shown = lit > black + _DARK
    reaches = all(
        np.abs(at[shown.mean(axis=axis) > _LINE]).max(initial=0.0)
        >= _REACH * min(radius, len(at) / 2)
        for at, axis in ((x, 0), (y, 1))
    )
    return radius / max(height, width) if bright and dark and reaches else float("inf")


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    scale = min(1.0, _SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA).max(axis=-1))
