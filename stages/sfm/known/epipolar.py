"""Checks given poses by epipolar geometry: matches must lie near each other's epipolar lines."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import fmean, median

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
        misfits: numbers of the frames that the poses in use do not fit (`misfits`).
        upside_down: of those among them that fit when turned by 180 degrees.
    """

    pairs: int
    given: float | None
    rough: float | None
    refined: float | None = None
    misfits: Sequence[int] = ()
    upside_down: Sequence[int] = ()


MatchedPair = tuple[int, int, NDArray[np.float64], NDArray[np.float64]]

INLIER_DISTANCE = 0.0025  # of the longer side: 4 px of 1600
ROUGH = 4.0  # x the distance of inliers, for rough poses
MISFIT_RATIO, FIT_RATIO = 0.1, 0.5  # of a frame's median pair; by chance 1 % of the matches fit
MISFIT_PAIRS = 3  # that a frame must have to be examined
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


def misfits(
    pairs: Sequence[MatchedPair], ratios: NDArray[np.float64], frame_of: Sequence[int]
) -> list[int]:
    """Numbers of the frames whose median pair has a ratio below `MISFIT_RATIO`.

    The worst frame is found first, and its pairs no longer count: they say nothing against the
    other frame. `ratios` [Q] as of `inlier_ratios`; frame_of: number of each view's frame.
    """
    pairs_of = _ratios_of_frames(pairs, ratios, frame_of)
    found: list[int] = []
    while True:
        bad = {
            frame: fmean(values)
            for frame, others in pairs_of.items()
            if len(values := [ratio for _, ratio in others]) >= MISFIT_PAIRS
            and median(values) < MISFIT_RATIO
        }
        if not bad:
            return sorted(found)
        worst = min(sorted(bad), key=bad.__getitem__)
        found.append(worst)
        for other in {other for other, _ in pairs_of.pop(worst)}:
            pairs_of[other] = [pair for pair in pairs_of[other] if pair[0] != worst]


def upside_down(
    pairs: Sequence[MatchedPair],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    sizes: NDArray[np.float64],
    frame_of: Sequence[int],
    among: Collection[int],
) -> list[int]:
    """The frames of those `among` whose median pair fits roughly when their pictures are turned by
    180 degrees, as if the poses were for pixels that an EXIF orientation has turned.

    Args:
        pairs, intrinsics, world_to_camera: as in `inlier_ratios`.
        sizes: [V, 2] width and height of each view.
        frame_of: number of each view's frame.
        among: numbers of frames.
    """

    def turned(view: int, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return sizes[view] - pixels if frame_of[view] in among else pixels

    concerned = [pair for pair in pairs if {frame_of[pair[0]], frame_of[pair[1]]} & set(among)]
    with_turned = [(i, j, turned(i, a), turned(j, b)) for i, j, a, b in concerned]
    side = ROUGH * float(sizes.max())
    ratios = inlier_ratios(with_turned, intrinsics, world_to_camera, side)
    pairs_of = _ratios_of_frames(with_turned, ratios, frame_of)
    return [
        frame
        for frame in sorted(among)
        if pairs_of[frame] and median(ratio for _, ratio in pairs_of[frame]) >= FIT_RATIO
    ]


def _ratios_of_frames(
    pairs: Sequence[MatchedPair], ratios: NDArray[np.float64], frame_of: Sequence[int]
) -> dict[int, list[tuple[int, float]]]:
    """(other frame, ratio) of each frame's pairs that have a ratio."""
    found: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for (first, second, *_), ratio in zip(pairs, ratios.tolist(), strict=True):
        if not np.isnan(ratio):
            found[frame_of[first]].append((frame_of[second], ratio))
            found[frame_of[second]].append((frame_of[first], ratio))
    return found


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
