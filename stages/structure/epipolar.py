"""Do given poses fit the photographs? Matches must lie on each other's epipolar lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

MatchedPair = tuple[int, int, NDArray[np.float64], NDArray[np.float64]]

INLIER_DISTANCE = 0.0025  # of the longer side: 4 px of 1600
_ROUNDING = 1e-9
_OURS_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def median_inlier_ratio(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    side: float,
) -> float | None:
    """The median over pairs of `fitting_shares`; None without pairs, and where all are seen from
    one place."""
    shares = inlier_ratios(pairs, intrinsics, world_to_camera, side)
    told = shares[~np.isnan(shares)]
    return float(np.median(told)) if len(told) else None


def inlier_ratios(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    side: float,
) -> NDArray[np.float64]:
    """[Q] share of each pair's matches within `NEAR` x `side` of where the poses want them; NaN for
    a pair seen from one place, which says nothing.

    pairs: (first, second, pixels in the first [N, 2], in the second) by position. intrinsics
    [V, 4] fx, fy, cx, cy; world_to_camera [V, 4, 4].
    """
    shares = np.full(len(pairs), np.nan)
    nowhere = _ROUNDING * np.abs(world_to_camera[:, :3, 3]).max(initial=0.0)
    for number, (first, second, a, b) in enumerate(pairs):
        relative = world_to_camera[second] @ np.linalg.inv(world_to_camera[first])
        shift = relative[:3, 3]
        if np.linalg.norm(shift) <= nowhere:
            continue
        essential = _cross(shift) @ relative[:3, :3]
        left, right = _pixel_matrix(intrinsics[second]), _pixel_matrix(intrinsics[first])
        shares[number] = (
            _sampson(left.T @ essential @ right, a, b) < INLIER_DISTANCE * side
        ).mean()
    return shares


def likely_mistakes(poses: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """What people hand over by mistake, put right: (the mistake in words, poses [V, 4, 4])."""
    inverse = np.asarray(np.linalg.inv(poses), np.float64)
    yield (
        "y and z of each camera are turned round: is this a file with OpenGL's axes, read as one "
        "with OpenCV's, or the other way round?",
        _OURS_FROM_OPENGL @ poses,
    )
    yield "each pose is inverted: is it camera to world where world to camera is meant?", inverse
    yield (
        "each pose is inverted, and y and z are turned round: is it OpenGL's camera to world?",
        _OURS_FROM_OPENGL @ inverse,
    )
    yield (
        "each photograph takes the camera after its own: are they in order?",
        np.roll(poses, -1, axis=0),
    )
    yield (
        "each photograph takes the camera before its own: are they in order?",
        np.roll(poses, 1, axis=0),
    )
    yield "the cameras are taken in the opposite order: are they in order?", poses[::-1]


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _pixel_matrix(lens: NDArray[np.float64]) -> NDArray[np.float64]:
    fx, fy, cx, cy = lens
    return np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def _sampson(
    fundamental: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] pixels: about how far a match must move to fit (Sampson's distance)."""
    one = np.ones((len(a), 1))
    a, b = np.hstack([a, one]), np.hstack([b, one])
    line_b, line_a = a @ fundamental.T, b @ fundamental
    over = np.abs(np.sum(b * line_b, axis=1))
    below = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
    return np.asarray(over / np.maximum(below, 1e-300))
