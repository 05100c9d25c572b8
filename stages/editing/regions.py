"""Regions of space: a box, a sphere, the convex hull of points, or a lasso."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError
from scipy.spatial import ConvexHull, QhullError

from stages.base.bad_files import BadFileError, FileKind, reading
from stages.base.errors import UsageError
from stages.base.text import reason_of

Inside = Callable[[NDArray[np.float64]], NDArray[np.bool_]]  # points [M, 3] -> [M]
_HULL = FileKind(
    "edit-hull-unreadable",
    "the points of a hull",
    "A .json with a list of [x, y, z], or a .ply with vertices; at least four, not in one plane.",
    "Write the corners down, or save them as points from another program.",
)
_VIEW = 12  # numbers of a lasso that hold its camera


def parse_region(text: str) -> Inside:
    """Which points lie in the region `box:x0,y0,z0,x1,y1,z1`, `sphere:x,y,z,r`, `hull:FILE` or
    `lasso:...`, which the page of `splat view` writes; its boundary is included. Raises SplatError
    "edit-region", "edit-hull-unreadable"."""
    kind, _, rest = text.partition(":")
    if kind == "box" and (ends := parse_numbers(rest, 6)) is not None:
        low, high = ends[:3], ends[3:]
        if (low <= high).all():
            return lambda at: np.asarray(((at >= low) & (at <= high)).all(axis=1))
    if kind == "sphere" and (ball := parse_numbers(rest, 4)) is not None and ball[3] > 0:
        middle, radius = ball[:3], ball[3]
        return lambda at: np.asarray(np.linalg.norm(at - middle, axis=1) <= radius)
    if kind == "hull" and rest:
        return _inside_hull(Path(rest))
    if kind == "lasso" and (drawn := parse_numbers(rest, rest.count(",") + 1)) is not None:
        view, corners = drawn[:_VIEW], drawn[_VIEW:]
        if len(corners) >= 6 and len(corners) % 2 == 0:
            return _inside_lasso(view, corners.reshape(-1, 2))
    raise UsageError(
        "edit-region",
        given=f"{text[:100]!r} is no region of space.",
        wanted="box:x0,y0,z0,x1,y1,z1 with its lowest corner first, sphere:x,y,z,r, hull:FILE, or "
        "lasso: and its numbers.",
        hint="`splat info` prints the bounds; the page of `splat view` writes a lasso.",
    )


def parse_numbers(text: str, count: int) -> NDArray[np.float64] | None:
    """[count] finite numbers separated by commas; None for any other text."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        return None
    return values if len(values) == count and np.isfinite(values).all() else None


def _inside_hull(path: Path) -> Inside:
    with reading(path, _HULL):
        points = _points(path)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
            raise BadFileError("it holds no four points of three numbers")
        if not np.isfinite(points).all():
            raise BadFileError("not all of its numbers are finite")
        try:
            faces = np.unique(ConvexHull(points).equations, axis=0)
        except QhullError as error:
            raise BadFileError("its points lie in one plane") from error
    slack = 1e-9 * float(np.abs(points).max())

    def inside(at: NDArray[np.float64]) -> NDArray[np.bool_]:
        found = np.ones(len(at), bool)
        for face in faces:
            found &= at @ face[:3] + face[3] <= slack
        return found

    return inside


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
        found = np.zeros(len(at), bool)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / depth, v / depth
            for (ax, ay), (bx, by) in zip(corners, np.roll(corners, 1, axis=0), strict=True):
                passed = u < (bx - ax) * (v - ay) / (by - ay) + ax
                found ^= ((ay > v) != (by > v)) & passed
        return np.asarray(found & (depth > 0))

    return inside


def _points(path: Path) -> NDArray[np.float64]:
    if path.suffix.lower() == ".json":
        return np.array(json.loads(path.read_text(encoding="utf-8")), np.float64)

    try:
        vertices = PlyData.read(str(path))["vertex"]
    except PlyParseError as error:
        raise BadFileError(f"it is no .ply ({reason_of(error)})") from error
    return np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
