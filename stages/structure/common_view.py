"""Random points in the space that many cameras see, for scenes without any other points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import SplatError
from stages.scene import Camera

RANDOM_POINTS = 20_000
_PARALLEL = 0.02  # smallest eigenvalue per camera; below, the optical axes are nearly parallel
_SHARE = 0.5  # of the cameras must see a point


def count_views(cameras: Sequence[Camera], points: NDArray[np.float64]) -> NDArray[np.int32]:
    """[P] number of cameras that have each point in their picture."""
    count = np.zeros(len(points), np.int32)
    for camera in cameras:
        pixels, z = camera.project(points)
        count += camera.shows(pixels) & (z > 0)
    return count


def random_points(
    cameras: Sequence[Camera], seed: int, outside: Sequence[NDArray[np.bool_] | None] = ()
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(points [P, 3] in a ball that most cameras see, its centre [3], its radius).

    The centre is the point nearest to all optical axes (least squares); the radius is the median of
    what a camera sees around it.

    Args:
        cameras: pinholes.
        seed: of the random points.
        outside: for each camera, the pixels [H, W] that show empty space; None for none.

    Raises SplatError "cameras-no-common-view".
    """
    centres = np.array([camera.centre for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    perpendicular = np.eye(3) - np.einsum("vi,vj->vij", forward, forward)
    scatter = perpendicular.mean(axis=0)
    if np.linalg.eigvalsh(scatter)[0] < _PARALLEL:
        raise _no_common_view("Their optical axes are nearly parallel")
    middle = np.linalg.solve(scatter, np.einsum("vij,vj->i", perpendicular, centres) / len(cameras))
    depth = np.einsum("vi,vi->v", middle - centres, forward)
    half = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    ahead = depth > 0
    if ahead.mean() < _SHARE:
        raise _no_common_view("Most of them look away from where their optical axes meet")
    radius = float(np.median(depth[ahead] * np.sin(np.arctan(half))[ahead]))
    random = np.random.default_rng(seed)
    directions = random.normal(size=(4 * RANDOM_POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = radius * np.cbrt(random.uniform(size=(len(directions), 1)))
    points = middle + lengths * directions
    points = points[count_views(cameras, points) >= _SHARE * len(cameras)]
    for camera, empty in zip(cameras, outside, strict=False):
        if empty is not None:
            points = points[~_in_empty_space(camera, empty, points)]
    points = points[:RANDOM_POINTS]
    if len(points) < RANDOM_POINTS // 20:
        raise _no_common_view("Few of them see the same part of space")
    return points, middle, radius


def _in_empty_space(
    camera: Camera, empty: NDArray[np.bool_], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """[P] whether a point projects to a pixel of `empty`."""
    pixels, z = camera.project(points)
    shown = camera.shows(pixels) & (z > 0)
    columns, rows = np.floor(pixels[shown]).astype(np.int64).T
    found = np.zeros(len(points), np.bool_)
    found[shown] = empty[rows, columns]
    return found


def _no_common_view(why: str) -> SplatError:
    return SplatError(
        "cameras-no-common-view",
        given=f"Matches give too few points, and random points need a common view. {why}.",
        wanted="Cameras around a subject, photographs with texture, or points in the file.",
        hint="Export the cameras together with their sparse points.",
    )
