"""Capture coverage: which surfaces the photographs show, from which sides, and what they miss.

Splats are gathered into patches, the cubes of a grid. A view sees a patch if the area that it shows
of it is at least a tenth of the area that the best view of that patch shows. So an occluded patch
is not seen, and a patch seen edge-on hardly is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
SUBJECT_SHARE = 0.5  # of the largest view count: patches seen so often are the subject
_SIDE_PX = 240  # of the pictures that visibility is measured in
INWARD_ELEVATIONS_DEG = (0.0, 80.0)  # where somebody may hold a camera around a subject
OUTWARD_ELEVATIONS_DEG = (-50.0, 50.0)  # where cameras look outward
MIN_GAP_DEG = 40.0  # to the nearest view
_DIRECTIONS = 400
_CONE_DEG = 15.0
_BLOCKED_SHARE = 0.1  # of a cone's cross-section
_WALL_SHARE, _BEHIND_SHARE = 0.3, 0.05  # of the area: on a wall, at least; behind it, at most
_WALLS, _TRIED_PLANES = 3, 300


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


def _normalised(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))


def _widest_deg(offsets: NDArray[np.float64]) -> float:
    """The largest angle between any two of the vectors [K, 3]; 0 for one."""
    if len(offsets) < 2:
        return 0.0
    unit = _normalised(offsets)
    return float(np.degrees(np.arccos(np.clip((unit @ unit.T).min(), -1.0, 1.0))))


@dataclass(frozen=True)
class CameraLayout:
    """How the cameras of a capture are arranged.

    Args:
        inward: whether they look at a subject that they stand around; else they look outward.
        middle: [3] of what they show.
        directions: [V, 3] unit vectors: from the middle to each camera, or along its view where
            they look outward.
        up: [3] unit vector.
        distance: of the median camera from the middle, world units.
    """

    inward: bool
    middle: NDArray[np.float64]
    directions: NDArray[np.float64]
    up: NDArray[np.float64]
    distance: float

    def elevations_deg(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Angles of the directions [..., 3] above the horizon."""
        return np.asarray(np.degrees(np.arcsin(np.clip(directions @ self.up, -1.0, 1.0))))

    def azimuths_deg(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Angles of directions [..., 3] on the map, clockwise from its top; from -180 to 180."""
        right, ahead = self.map_axes
        return np.asarray(np.degrees(np.arctan2(directions @ right, directions @ ahead)))

    @property
    def map_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Two horizontal unit vectors [3]: to the right and up on a map seen from above."""
        z = np.array([0.0, 0.0, 1.0])
        ahead = z - (z @ self.up) * self.up
        if np.linalg.norm(ahead) < 0.1:  # up is along z
            ahead = np.array([0.0, 1.0, 0.0])
            ahead = ahead - (ahead @ self.up) * self.up
        ahead = _normalised(ahead)
        return np.cross(ahead, self.up), ahead


def camera_layout(cameras: Sequence[Camera], patches: Patches, levelled: bool) -> CameraLayout:
    """levelled: whether up is -Y; else it is the mean of the cameras' own up directions."""
    up = np.array([0.0, -1.0, 0.0])
    if not levelled:
        up = _normalised(-np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0))
    subject = patches.counts >= SUBJECT_SHARE * patches.counts.max()
    middle = weighted_quantile(patches.centres[subject], patches.area[subject], 0.5)
    eyes = np.array([camera.centre for camera in cameras])
    inward = np.mean([_shows(camera, middle) for camera in cameras]) > 0.5
    forward = np.array([camera.forward for camera in cameras])
    distance = float(np.median(np.linalg.norm(eyes - middle, axis=1)))
    directions = _normalised(eyes - middle) if inward else forward
    return CameraLayout(bool(inward), middle, directions, up, distance)


def _shows(camera: Camera, point: NDArray[np.float64]) -> bool:
    pixels, z = camera.project(point[None])
    return bool(z[0] > 0 and camera.shows(pixels)[0])


@dataclass(frozen=True)
class Gap:
    """A direction that no view is near.

    Args:
        direction: [3] unit vector, as in `CameraLayout`.
        angle_deg: to the nearest view.
        nearest: index of that view.
    """

    direction: NDArray[np.float64]
    angle_deg: float
    nearest: int


def find_gaps(
    layout: CameraLayout, patches: Patches, cameras: Sequence[Camera], most: int = 3
) -> tuple[Gap, ...]:
    """The emptiest directions, largest gap first; each is found as if the gaps before it were
    filled. Left out are directions where a surface is in the way, which are behind a wall, or where
    nobody could hold a camera."""
    tried = _sphere(_DIRECTIONS)
    elevations = layout.elevations_deg(tried)
    lowest, highest = INWARD_ELEVATIONS_DEG if layout.inward else OUTWARD_ELEVATIONS_DEG
    tried = tried[(elevations >= lowest) & (elevations <= highest)]
    if layout.inward:
        tried = tried[[not _blocked(layout, patches, direction) for direction in tried]]
        for normal, offset in _walls(patches, np.array([camera.centre for camera in cameras])):
            places = layout.middle + layout.distance * tried
            tried = tried[places @ normal > offset]
    known, found = layout.directions, []
    for _ in range(most):
        if not len(tried):
            break
        closeness = np.clip(tried @ known.T, -1.0, 1.0)
        emptiest = int(closeness.max(axis=1).argmin())
        angle = float(np.degrees(np.arccos(closeness[emptiest].max())))
        if angle < MIN_GAP_DEG:
            break
        views = closeness[emptiest, : len(layout.directions)]
        found.append(Gap(tried[emptiest], angle, int(views.argmax())))
        known = np.concatenate([known, tried[emptiest][None]])
    return tuple(found)


def _sphere(count: int) -> NDArray[np.float64]:
    """[count, 3] directions, evenly spaced (Fibonacci lattice)."""
    number = np.arange(count) + 0.5
    y = 1 - 2 * number / count
    turn = np.pi * (1 + 5**0.5) * number
    across = np.sqrt(1 - y * y)
    return np.stack([across * np.cos(turn), y, across * np.sin(turn)], axis=1)


def _blocked(layout: CameraLayout, patches: Patches, direction: NDArray[np.float64]) -> bool:
    """Whether a surface is between the middle and where a camera would be."""
    offsets = patches.centres - layout.middle
    along = offsets @ direction
    beside = np.linalg.norm(offsets - along[:, None] * direction, axis=1)
    cone = np.tan(np.radians(_CONE_DEG))
    inside = (along > 0.5 * layout.distance) & (along < layout.distance) & (beside < cone * along)
    cross_section = np.pi * (cone * layout.distance) ** 2
    return bool(patches.area[inside].sum() > _BLOCKED_SHARE * cross_section)


def _walls(
    patches: Patches, eyes: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float64], float]]:
    """(normal [3] towards the cameras, offset) of planes that are walls.

    A wall holds much of the area and hides nearly none of it, and all cameras, with centres `eyes`
    [V, 3], are in front of it. Planes through three random patches are tried (RANSAC).
    """
    total = patches.area / max(patches.area.sum(), 1e-12)
    share = total
    for number in range(_WALLS):
        if share.sum() < _WALL_SHARE:
            return
        chances = share / share.sum()
        draw = np.random.default_rng(number).choice(len(share), (_TRIED_PLANES, 3), p=chances)
        a, b, c = patches.centres[draw].transpose(1, 0, 2)
        normals = _normalised(np.cross(b - a, c - a))
        offsets = (normals * a).sum(axis=1)
        towards = np.sign(eyes.mean(axis=0) @ normals.T - offsets)
        normals, offsets = normals * towards[:, None], offsets * towards
        heights = patches.centres @ normals.T - offsets
        on = np.abs(heights) < patches.side
        fits = (eyes @ normals.T > offsets).all(axis=0)
        fits &= total @ (heights < -patches.side) <= _BEHIND_SHARE
        held = np.where(fits, share @ on, 0.0)
        best = int(held.argmax())
        if held[best] < _WALL_SHARE:
            return
        yield normals[best], float(offsets[best])
        share = np.where(on[:, best], 0.0, share)


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
