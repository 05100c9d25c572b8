"""Capture coverage: how many photographs show each surface, and over what angle.

Splats are gathered into patches, the cubes of a grid. A view sees a patch if the area that it shows
of it is at least a tenth of the area that the best view of that patch shows. So an occluded patch
is not seen, and a patch seen edge-on hardly is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stages.evaluate.contribution import blend_weights
from stages.scene import Camera, Splats

MIN_VIEWS = 3  # one shows a surface, two measure its depth, the third confirms it
MIN_ANGLE_DEG = 10.0  # between views: over less, depth is hardly measured
PATCHES_ACROSS = 32  # along the diagonal of the middle nine tenths of what is seen
MIN_PX = 2.0  # summed blend weight: a patch that covers less of a picture is not seen
MIN_SHARE = 0.1  # of the area that the best view shows
_SIDE_PX = 240  # of the pictures that visibility is measured in


@dataclass(frozen=True)
class Patches:
    """What V views show of M patches.

    Args:
        centres: [M, 3].
        side: of each cube, world units.
        area: [M] what the best view shows, world units^2.
        seen: [M, V] by which views.
        best: [M] the view that shows most of it.
        angles_deg: [M] between the two farthest views that see it, as seen from the patch.
    """

    centres: NDArray[np.float64]
    side: float
    area: NDArray[np.float64]
    seen: NDArray[np.bool_]
    best: NDArray[np.intp]
    angles_deg: NDArray[np.float64]

    @property
    def counts(self) -> NDArray[np.intp]:
        """[M] the number of views that see each patch."""
        return np.asarray(self.seen.sum(axis=1))

    @property
    def median_count(self) -> int:
        """The median view count, weighted by area."""
        order = np.argsort(-self.counts, kind="stable")
        running = np.cumsum(self.area[order])
        return int(self.counts[order[np.searchsorted(running, running[-1] / 2)]])

    @property
    def poorly_covered(self) -> NDArray[np.bool_]:
        """[M] seen by too few views, or over too small an angle."""
        return (self.counts < MIN_VIEWS) | (self.angles_deg < MIN_ANGLE_DEG)


def patches_of(splats: Splats, cameras: Sequence[Camera], backend: str) -> Patches:
    """The patches that the cameras see of `splats`; none where they see nothing."""
    small = [camera.fitted(_SIDE_PX) for camera in cameras]
    pixels = np.zeros((len(splats), len(small)), np.float32)
    for column, (rows, weights) in enumerate(blend_weights(splats, small, backend)):
        pixels[rows, column] = weights
    means, total = splats.means.astype(np.float64), pixels.sum(axis=1)
    shown = np.flatnonzero(total > 0)
    if not len(shown):
        none = np.zeros(0)
        seen = np.zeros((0, len(small)), bool)
        return Patches(np.zeros((0, 3)), 1.0, none, seen, np.zeros(0, np.intp), none)
    low, high = (weighted_quantile(means[shown], total[shown], q) for q in (0.05, 0.95))
    side = max(float(np.linalg.norm(high - low)) / PATCHES_ACROSS, 1e-9)
    cubes, which = np.unique(np.floor(means[shown] / side), axis=0, return_inverse=True)
    which = which.ravel()
    gathered = np.zeros((len(cubes), len(small)))
    np.add.at(gathered, which, pixels[shown])
    weighted = [np.bincount(which, total[shown] * means[shown, axis]) for axis in range(3)]
    centres = np.stack(weighted, axis=1) / np.bincount(which, total[shown])[:, None]
    return _patches(centres.astype(np.float64), side, gathered, small)


def _patches(
    centres: NDArray[np.float64],
    side: float,
    pixels: NDArray[np.float64],
    cameras: Sequence[Camera],
) -> Patches:
    """pixels [M, V]: what each patch covers in each picture."""
    depths = np.stack([camera.project(centres)[1] for camera in cameras], axis=1)
    focals = np.array([camera.fx * camera.fy for camera in cameras])
    areas = pixels * np.maximum(depths, 0.0) ** 2 / focals
    areas[pixels < MIN_PX] = 0.0
    shown = areas.any(axis=1)
    centres, areas = centres[shown], areas[shown]
    seen = areas >= MIN_SHARE * areas.max(axis=1, initial=0.0, keepdims=True)
    best, area = areas.argmax(axis=1), areas.max(axis=1, initial=0.0)
    eyes = np.array([camera.centre for camera in cameras])
    angles = np.array(
        [_widest_deg(eyes[s] - c) for s, c in zip(seen, centres, strict=True)], np.float64
    )
    return Patches(centres, side, area, seen, best, angles)


def weighted_quantile(
    points: NDArray[np.float64], weights: NDArray[np.floating], share: float
) -> NDArray[np.float64]:
    """[3] the quantile of each coordinate."""
    found = np.quantile(points, share, axis=0, weights=weights, method="inverted_cdf")
    return np.asarray(found)


def _widest_deg(offsets: NDArray[np.float64]) -> float:
    """The largest angle between any two of the vectors [K, 3]; 0 for one."""
    if len(offsets) < 2:
        return 0.0
    unit = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip((unit @ unit.T).min(), -1.0, 1.0))))


@dataclass(frozen=True)
class PoorRegion:
    """Adjacent patches that are poorly covered.

    Args:
        centre: [3].
        share: of the area of all patches.
        views: how many see the median patch.
        angle_deg: over which they see it.
        best: the view that shows most of it.
    """

    centre: NDArray[np.float64]
    share: float
    views: int
    angle_deg: float
    best: int


def poorly_covered_regions(patches: Patches, most: int = 3) -> tuple[PoorRegion, ...]:
    """The regions of the largest area, largest first."""
    poor = np.flatnonzero(patches.poorly_covered)
    found = []
    for group in _connected(patches.centres[poor], patches.side):
        rows = poor[group]
        area = patches.area[rows]
        best = int(np.bincount(patches.best[rows], area).argmax())
        own = rows[patches.best[rows] == best]
        centre = patches.centres[own[patches.area[own].argmax()]]
        views, angle = np.median(patches.counts[rows]), np.median(patches.angles_deg[rows])
        share = float(area.sum() / patches.area.sum())
        found.append(PoorRegion(centre, share, int(views), float(angle), best))
    return tuple(sorted(found, key=lambda region: -region.share)[:most])


def _connected(centres: NDArray[np.float64], side: float) -> list[NDArray[np.intp]]:
    """Groups of rows whose cubes touch."""
    if not len(centres):
        return []
    pairs = cKDTree(np.floor(centres / side)).query_pairs(1.01, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(centres),) * 2)
    labels = connected_components(links, directed=False)[1]
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.cumsum(np.bincount(labels))[:-1])
