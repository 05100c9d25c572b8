"""Checks given poses by epipolar geometry: matches must lie near each other's epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PoseCheck:
    """Median inlier ratios of given poses (`median_inlier_ratio`); None without pairs to check.

    Args:
        pairs: how many matched.
        given: of the poses as they are given.
        rough: the same at four times the distance.
        refined: of refined poses; None as well if they were not refined.
    """

    pairs: int
    given: float | None
    rough: float | None
    refined: float | None = None


MatchedPair = tuple[int, int, NDArray[np.float64], NDArray[np.float64]]

INLIER_DISTANCE = 0.0025  # of the longer side: 4 px of 1600
_ROUNDING = 1e-9


def median_inlier_ratio(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    side: float,
) -> float | None:
    """The median of `inlier_ratios`; None without pairs, and where no pair has a baseline."""
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
