"""Regions of space: a box, a sphere, or a lasso."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import UsageError

Inside = Callable[[NDArray[np.float64]], NDArray[np.bool_]]  # points [M, 3] -> [M]
_VIEW = 12  # numbers of a lasso that hold its camera


def parse_region(text: str) -> Inside:
    """Which points lie in the region `box:x0,y0,z0,x1,y1,z1`, `sphere:x,y,z,r` or `lasso:...`,
    which the page of `splat view` writes; its boundary is included. Raises SplatError
    "edit-region"."""
    kind, _, rest = text.partition(":")
    if kind == "box" and (ends := parse_numbers(rest, 6)) is not None:
        low, high = ends[:3], ends[3:]
        if (low <= high).all():
            return lambda at: np.asarray(((at >= low) & (at <= high)).all(axis=1))
    if kind == "sphere" and (ball := parse_numbers(rest, 4)) is not None and ball[3] > 0:
        middle, radius = ball[:3], ball[3]
        return lambda at: np.asarray(np.linalg.norm(at - middle, axis=1) <= radius)
    if kind == "lasso" and (drawn := parse_numbers(rest, rest.count(",") + 1)) is not None:
        view, corners = drawn[:_VIEW], drawn[_VIEW:]
        if len(corners) >= 6 and len(corners) % 2 == 0:
            return _inside_lasso(view, corners.reshape(-1, 2))
    raise UsageError(
        "edit-region",
        given=f"{text[:100]!r} is no region of space.",
        wanted="box:x0,y0,z0,x1,y1,z1 with its lowest corner first, sphere:x,y,z,r, or lasso: and "
        "its numbers.",
        hint="`splat info` prints the bounds; under Select, the page of `splat view` names points.",
    )


def parse_numbers(text: str, count: int) -> NDArray[np.float64] | None:
    """[count] finite numbers separated by commas; None for any other text."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        return None
    return values if len(values) == count and np.isfinite(values).all() else None


def _inside_lasso(view: NDArray[np.float64], corners: NDArray[np.float64]) -> Inside:
    """Points whose projection lies inside a polygon (even-odd rule) and in front of the camera.

    The operations keep the order of the page's script, so that both give the same bits.

    Args:
        view: [12] three rows that take (x, y, z, 1) to u * depth, v * depth and depth.
        corners: [K, 2] the polygon in pixels.
    """

    def inside(at: NDArray[np.float64]) -> NDArray[np.bool_]:
        x, y, z = at.T
        u, v, depth = (a * x + b * y + c * z + d for a, b, c, d in view.reshape(3, 4))
        inside_lasso = np.zeros(len(at), bool)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / depth, v / depth
            for (ax, ay), (bx, by) in zip(corners, np.roll(corners, 1, axis=0), strict=True):
                passed = u < (bx - ax) * (v - ay) / (by - ay) + ax
                inside_lasso ^= ((ay > v) != (by > v)) & passed
        return np.asarray(inside_lasso & (depth > 0))

    return inside
