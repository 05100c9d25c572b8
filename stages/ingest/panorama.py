"""Recognises 360-degree pictures, which no perspective camera describes.

Google's photo sphere metadata (GPano) decides where a picture has it. Otherwise an equirectangular
picture of the whole sphere is recognised by its shape and edges: it is exactly twice as wide as
high, its left edge continues its right edge, and its first and last rows are uniform, because each
is one point of the sphere. The shape alone says nothing: phones take such photographs.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

_TAG = rb"GPano:%s\s*(?:=\s*[\"']|>)\s*(\w{1,40})"
_WIDTHS = (b"FullPanoWidthPixels", b"CroppedAreaImageWidthPixels")
_RATIO = 0.01  # by which a picture that its metadata call a panorama may differ from 2:1
_COLUMNS = 256  # of the reduced picture
_FEWEST = 64  # columns; smaller pictures are not examined
_SEAM = 3.5  # times the median difference of neighbouring columns
_EDGE = 0.35  # of the variation along an edge
_POLE = 0.5  # of the variation along a row in the middle
_CONTRAST = 4.0  # of 255: below, edges and rows say nothing
_DARK = 12.0  # of 255: what is outside the circles of two fisheyes
_SHARE = 0.95  # of the pixels outside the circles that are dark, and just inside that are not
EQUIRECTANGULAR = "equirectangular"
SPHERE = "a 360-degree panorama (equirectangular)"
_FISHEYES = "a pair of fisheye pictures side by side"
WHOLE = "Export the whole sphere, twice as wide as high, or photograph with an ordinary lens"
STITCH = (
    "Stitch it in the camera manufacturer's program, and export it equirectangular: twice as wide "
    "as high"
)


def projection_of(xmp: bytes) -> str:
    """GPano's ProjectionType in lower case ("equirectangular"), with "partial" before it if the
    picture shows a part of the circle; "" if there is none."""
    tag = re.search(_TAG % b"ProjectionType", xmp)
    if not tag:
        return ""
    whole, cropped = (re.search(_TAG % name, xmp) for name in _WIDTHS)
    part = "partial " if whole and cropped and whole[1] != cropped[1] else ""
    return part + tag[1].decode("ascii").lower()


def panorama(pixels: NDArray[np.uint8], stored: tuple[int, int], projection: str) -> str:
    """What kind of panorama a picture is, as the end of "it is ...": `SPHERE` for one that can be
    cut into faces, "" for an ordinary picture.

    Args:
        pixels: [H, W, C] upright.
        stored: (width, height) in the file.
        projection: see `projection_of`.
    """
    if projection:
        width, height = stored
        if projection == EQUIRECTANGULAR and abs(width / (2 * height) - 1) <= _RATIO:
            return SPHERE
        return f"a panorama ({projection}, {width} x {height}, as its metadata say)"
    if not look_decides(pixels, stored, projection):
        return ""
    small = _reduced(pixels)
    if _two_fisheyes(small):
        return _FISHEYES
    return SPHERE if _wraps(small) else ""


def look_decides(pixels: NDArray[np.uint8], stored: tuple[int, int], projection: str) -> bool:
    """Whether a picture may be a panorama and no metadata say so. Arguments as for `panorama`."""
    height, width = pixels.shape[:2]
    wide = max(stored) == 2 * min(stored) and width > height
    return wide and width >= _FEWEST and not projection


def hint_for(kind: str) -> str:
    """What to do about a kind of `panorama` that cannot be cut."""
    return STITCH if kind == _FISHEYES else WHOLE


def _reduced(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[H, W] mean of the channels over tiles, at most about `_COLUMNS` wide; the borders stay."""
    step = max(1, pixels.shape[1] // _COLUMNS)
    height, width = (side // step * step for side in pixels.shape[:2])
    grey = pixels[:height, :width].mean(axis=2)
    tiles: NDArray[np.float64] = grey.reshape(height // step, step, width // step, step)
    return np.asarray(tiles.mean(axis=(1, 3)))


def _wraps(grey: NDArray[np.float64]) -> bool:
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    seam = float(np.abs(grey[:, 0] - grey[:, -1]).mean())
    across, edge = float(np.median(grey.std(axis=1))), float(grey[:, 0].std())
    pole = min(float(grey[0].std()), float(grey[-1].std()))  # the other may be filled in or cut
    if min(across, edge) < _CONTRAST:
        return False
    goes_on = seam <= min(_SEAM * float(np.median(steps)), _EDGE * edge)
    return goes_on and pole <= _POLE * across


def _two_fisheyes(grey: NDArray[np.float64]) -> bool:
    height, width = grey.shape
    y, x = np.mgrid[:height, :width] + 0.5
    left, right = (np.hypot(x - share * width, y - height / 2) for share in (0.25, 0.75))
    away = np.minimum(left, right) / (height / 2)
    rim = (away > 0.8) & (away < 0.92)
    lit = grey > _DARK
    return bool((~lit)[away > 1.08].mean() > _SHARE and lit[rim].mean() > _SHARE)
