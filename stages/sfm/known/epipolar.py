"""Checks given poses by epipolar geometry: matches must lie near each other's epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

MatchedPair = tuple[int, int, NDArray[np.float64], NDArray[np.float64]]

INLIER_DISTANCE = 0.0025  # of the longer side: 4 px of 1600
_ROUNDING = 1e-9
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def median_inlier_ratio(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    side: float,
) -> float | None:
    """The median over pairs of `inlier_ratios`; None without pairs, and where all are seen from
    one place."""
    ratios = inlier_ratios(pairs, intrinsics, world_to_camera, side)
    ratios = ratios[~np.isnan(ratios)]
    return float(np.median(ratios)) if len(ratios) else None


def inlier_ratios(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    side: float,
) -> NDArray[np.float64]:
    """[Q] share of each pair's matches whose Sampson distance is below `INLIER_DISTANCE` x `side`;
    NaN for a pair without a baseline.

    Args:
        pairs: (first, second, pixels in the first [N, 2], in the second) by position.
        intrinsics: [V, 4] fx, fy, cx, cy.
        world_to_camera: [V, 4, 4].
        side: the longer side of the pictures, in pixels.
    """
    distances = (epipolar_distances(pair, intrinsics, world_to_camera) for pair in pairs)
    return np.array(
        [np.nan if d is None else (d < INLIER_DISTANCE * side).mean() for d in distances]
    )


def epipolar_distances(
    pair: MatchedPair, intrinsics: NDArray[np.float64], world_to_camera: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """[N] Sampson distance of each match, pixels; None without a baseline. See `inlier_ratios`."""
    first, second, a, b = pair
    relative = world_to_camera[second] @ np.linalg.inv(world_to_camera[first])
    baseline = relative[:3, 3]
    if np.linalg.norm(baseline) <= _ROUNDING * np.abs(world_to_camera[:, :3, 3]).max(initial=0.0):
        return None
    essential = _cross(baseline) @ relative[:3, :3]
    left, right = _pixel_matrix(intrinsics[second]), _pixel_matrix(intrinsics[first])
    return _sampson(left.T @ essential @ right, a, b)


def likely_mistakes(poses: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Common mistakes in camera files, each with the poses [V, 4, 4] corrected for it."""
    inverse = np.asarray(np.linalg.inv(poses), np.float64)
    return {
        "y and z of each camera are negated: does the file have OpenGL's axes where OpenCV's are "
        "expected, or the reverse?": _OPENCV_FROM_OPENGL @ poses,
        "each pose is inverted: does the file have camera to world instead of world to "
        "camera?": inverse,
        "each pose is inverted, and y and z are negated: does the file have OpenGL's camera to "
        "world?": _OPENCV_FROM_OPENGL @ inverse,
        "each photograph has the camera after its own: are they in order?": np.roll(poses, -1, 0),
        "each photograph has the camera before its own: are they in order?": np.roll(poses, 1, 0),
        "the cameras are in the opposite order: are they in order?": poses[::-1],
    }


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _pixel_matrix(lens: NDArray[np.float64]) -> NDArray[np.float64]:
    fx, fy, cx, cy = lens
    return np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def _sampson(
    fundamental: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] Sampson distance in pixels: about how far a match lies from fitting exactly."""
    one = np.ones((len(a), 1))
    a, b = np.hstack([a, one]), np.hstack([b, one])
    line_b, line_a = a @ fundamental.T, b @ fundamental
    numerator = np.abs(np.sum(b * line_b, axis=1))
    denominator = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
    return np.asarray(numerator / np.maximum(denominator, 1e-300))
