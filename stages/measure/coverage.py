"""Which surfaces photographs show, and from which sides: where a capture is thin.

Splats are gathered into patches, cubes of the scene. A photograph sees a patch if what it shows of
it, in world units, is no less than a tenth of what the photograph that shows most of it does: so
what lies behind something else is not seen, and what is seen edge on hardly is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.backends import rasteriser_of
from stages.raster.definition import WEIGHT, splat_arrays
from stages.raster.draw import raster_settings_of, render
from stages.scene import Camera, Splats, look_at

FEW_PHOTOGRAPHS = 3  # one sees, two measure, the third confirms
SMALL_ANGLE_DEG = 10.0  # seen over less, a depth is little more than a guess
PATCHES_ACROSS = 32  # of the middle nine tenths of what is seen, corner to corner
LEAST_PX = 2.0  # a patch that shows less, summed over its pixels, is not seen
LEAST_SHARE = 0.1
OFTEN = 0.5  # of what most photographs share: what is seen so often is the subject
_SIDE_PX = 240  # of the pictures that visibility is found from
_PROBE_PX = 96
FLOOR_DEG, TOP_DEG = 0.0, 80.0  # heights that somebody may hold a camera at, around a subject
OUTWARD_DEG = 50.0  # up or down, where cameras look outward
GAP_DEG = 40.0  # to the nearest photograph: less is not worth a word
_DIRECTIONS = 400
_CONE_DEG = 15.0
_BLOCKED_SHARE = 0.1  # of a cone's cross section


@dataclass(frozen=True)
class Patches:
    """What photographs show. centres [M, 3]; side: of each cube, world units. area [M]: what the
    photograph that shows most of it shows, world units^2. seen [M, V]: by which photographs.
    best [M]: the one that shows most. angles_deg [M]: between the two photographs farthest apart
    that see it, as it sees them."""

    centres: NDArray[np.float64]
    side: float
    area: NDArray[np.float64]
    seen: NDArray[np.bool_]
    best: NDArray[np.intp]
    angles_deg: NDArray[np.float64]

    @property
    def counts(self) -> NDArray[np.intp]:
        """[M] photographs that see each."""
        return np.asarray(self.seen.sum(axis=1))

    @property
    def median_count(self) -> int:
        """Of photographs, by area: half of what is seen is seen by so many or more."""
        order = np.argsort(-self.counts, kind="stable")
        running = np.cumsum(self.area[order])
        return int(self.counts[order[np.searchsorted(running, running[-1] / 2)]])

    @property
    def thin(self) -> NDArray[np.bool_]:
        """[M] seen by too few, or from one side only."""
        return (self.counts < FEW_PHOTOGRAPHS) | (self.angles_deg < SMALL_ANGLE_DEG)


def patches_of(splats: Splats, cameras: Sequence[Camera], backend: str) -> Patches:
    """Patches of `splats` as the cameras see them; none where they see nothing."""
    small = [camera.fitted(_SIDE_PX) for camera in cameras]
    rasteriser, arrays, settings = (
        rasteriser_of(backend),
        splat_arrays(splats),
        raster_settings_of(splats),
    )
    pixels = np.zeros((len(splats), len(small)), np.float32)
    for column, camera in enumerate(small):
        forward = rasteriser.forward(arrays, camera, settings)
        nothing = np.zeros((3, camera.height, camera.width), np.float32)
        pixels[forward.visible, column] = rasteriser.contributions(forward, nothing)[:, WEIGHT]
    means, total = splats.means.astype(np.float64), pixels.sum(axis=1)
    shown = np.flatnonzero(total > 0)
    if not len(shown):
        none = np.zeros(0)
        seen = np.zeros((0, len(small)), bool)
        return Patches(np.zeros((0, 3)), 1.0, none, seen, np.zeros(0, np.intp), none)
    low, high = (_weighted_quantile(means[shown], total[shown], q) for q in (0.05, 0.95))
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
    areas[pixels < LEAST_PX] = 0.0
    there = areas.any(axis=1)
    centres, areas = centres[there], areas[there]
    seen = areas >= LEAST_SHARE * areas.max(axis=1, initial=0.0, keepdims=True)
    best, area = areas.argmax(axis=1), areas.max(axis=1, initial=0.0)
    eyes = np.array([camera.centre for camera in cameras])
    angles = np.array(
        [_widest_deg(eyes[s] - c) for s, c in zip(seen, centres, strict=True)], np.float64
    )
    return Patches(centres, side, area, seen, best, angles)


def _weighted_quantile(
    points: NDArray[np.float64], weights: NDArray[np.floating], share: float
) -> NDArray[np.float64]:
    """[3] by coordinate."""
    found = []
    for column in points.T:
        order = np.argsort(column)
        running = np.cumsum(weights[order], dtype=np.float64)
        found.append(column[order[np.searchsorted(running, share * running[-1])]])
    return np.array(found)


def _units(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))


def _widest_deg(offsets: NDArray[np.float64]) -> float:
    """The largest angle between any two of the vectors [K, 3]; 0 for one."""
    if len(offsets) < 2:
        return 0.0
    unit = _units(offsets)
    return float(np.degrees(np.arccos(np.clip((unit @ unit.T).min(), -1.0, 1.0))))


@dataclass(frozen=True)
class Around:
    """Where cameras stand around what they show, or, where they look outward, where they look.

    inward: which of the two. middle [3]: of what they show. directions [V, 3]: unit, from the
    middle to each camera, or along its view. up [3]. reach: of the median camera, world units.
    """

    inward: bool
    middle: NDArray[np.float64]
    directions: NDArray[np.float64]
    up: NDArray[np.float64]
    reach: float

    def heights_deg(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Above the horizon, of [..., 3]."""
        return np.asarray(np.degrees(np.arcsin(np.clip(directions @ self.up, -1.0, 1.0))))

    def headings_deg(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """On the map, clockwise from its top, of [..., 3]; from -180 to 180."""
        right, ahead = self.plan
        return np.asarray(np.degrees(np.arctan2(directions @ right, directions @ ahead)))

    @property
    def plan(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Two horizontal unit vectors [3]: to the right and up on a map seen from above."""
        z = np.array([0.0, 0.0, 1.0])
        ahead = z - (z @ self.up) * self.up
        if np.linalg.norm(ahead) < 0.1:  # up is along z
            ahead = np.array([0.0, 1.0, 0.0])
            ahead = ahead - (ahead @ self.up) * self.up
        ahead = _units(ahead)
        return np.cross(ahead, self.up), ahead


def around(cameras: Sequence[Camera], patches: Patches, levelled: bool) -> Around:
    """levelled: whether up is -Y; else it is where most cameras' tops point."""
    up = np.array([0.0, -1.0, 0.0])
    if not levelled:
        up = _units(-np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0))
    often = patches.counts >= OFTEN * patches.counts.max()
    middle = _weighted_quantile(patches.centres[often], patches.area[often], 0.5)
    eyes = np.array([camera.centre for camera in cameras])
    inward = np.mean([_shows(camera, middle) for camera in cameras]) > 0.5
    views = np.array([camera.forward for camera in cameras])
    reach = float(np.median(np.linalg.norm(eyes - middle, axis=1)))
    return Around(bool(inward), middle, _units(eyes - middle) if inward else views, up, reach)


def _shows(camera: Camera, place: NDArray[np.float64]) -> bool:
    pixels, z = camera.project(place[None])
    return bool(z[0] > 0 and camera.shows(pixels)[0])


@dataclass(frozen=True)
class Gap:
    """A side that no photograph is near. direction [3]: unit, as in `Around`. angle_deg: to the
    nearest photograph, number `nearest`."""

    direction: NDArray[np.float64]
    angle_deg: float
    nearest: int


def gaps(ring: Around, patches: Patches, most: int = 3) -> tuple[Gap, ...]:
    """The emptiest sides, each as if a photograph had filled those before; none where something
    stands in the way, or where nobody could hold a camera."""
    tried = _sphere(_DIRECTIONS)
    heights = ring.heights_deg(tried)
    lowest, highest = (FLOOR_DEG, TOP_DEG) if ring.inward else (-OUTWARD_DEG, OUTWARD_DEG)
    tried = tried[(heights >= lowest) & (heights <= highest)]
    if ring.inward:
        tried = tried[[not _blocked(ring, patches, direction) for direction in tried]]
    known, found = ring.directions, []
    for _ in range(most):
        if not len(tried):
            break
        closeness = np.clip(tried @ known.T, -1.0, 1.0)
        emptiest = int(closeness.max(axis=1).argmin())
        angle = float(np.degrees(np.arccos(closeness[emptiest].max())))
        if angle < GAP_DEG:
            break
        photographs = closeness[emptiest, : len(ring.directions)]
        found.append(Gap(tried[emptiest], angle, int(photographs.argmax())))
        known = np.concatenate([known, tried[emptiest][None]])
    return tuple(found)


def _sphere(count: int) -> NDArray[np.float64]:
    """[count, 3] directions, evenly."""
    number = np.arange(count) + 0.5
    y = 1 - 2 * number / count
    turn = np.pi * (1 + 5**0.5) * number
    across = np.sqrt(1 - y * y)
    return np.stack([across * np.cos(turn), y, across * np.sin(turn)], axis=1)


def _blocked(ring: Around, patches: Patches, direction: NDArray[np.float64]) -> bool:
    """Whether a surface stands between the middle and where a camera would."""
    offsets = patches.centres - ring.middle
    along = offsets @ direction
    beside = np.linalg.norm(offsets - along[:, None] * direction, axis=1)
    cone = np.tan(np.radians(_CONE_DEG))
    inside = (along > 0.5 * ring.reach) & (along < ring.reach) & (beside < cone * along)
    return bool(patches.area[inside].sum() > _BLOCKED_SHARE * np.pi * (cone * ring.reach) ** 2)


@dataclass(frozen=True)
class Place:
    """Thin patches that lie together. centre [3]. share: of all that is seen, by area. photographs:
    how many see the median patch. angle_deg: over which angle. best: the photograph that shows most
    of it. step: where to stand next to it ("left", "right", "higher"); "" where none would see."""

    centre: NDArray[np.float64]
    share: float
    photographs: int
    angle_deg: float
    best: int
    step: str


def thin_places(
    splats: Splats, patches: Patches, cameras: Sequence[Camera], backend: str, most: int = 3
) -> tuple[Place, ...]:
    """The largest, first."""
    thin = np.flatnonzero(patches.thin)
    groups = _together(patches.centres[thin], patches.side)
    found = []
    for group in groups:
        rows = thin[group]
        area = patches.area[rows]
        best = int(np.bincount(patches.best[rows], area).argmax())
        own = rows[patches.best[rows] == best]
        centre = patches.centres[own[patches.area[own].argmax()]]
        middle = np.median(patches.counts[rows]), np.median(patches.angles_deg[rows])
        share = float(area.sum() / patches.area.sum())
        found.append(Place(centre, share, int(middle[0]), float(middle[1]), best, ""))
    found = sorted(found, key=lambda place: -place.share)[:most]
    return tuple(replace(p, step=_step(splats, p, cameras[p.best], backend)) for p in found)


def _together(centres: NDArray[np.float64], side: float) -> list[NDArray[np.intp]]:
    """Groups of rows whose cubes touch."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(centres):
        return []
    pairs = cKDTree(np.floor(centres / side)).query_pairs(1.01, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(centres),) * 2)
    labels = connected_components(links, directed=False)[1]
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.cumsum(np.bincount(labels))[:-1])


def _step(splats: Splats, place: Place, camera: Camera, backend: str) -> str:
    """The first step aside, twice the angle that is wanted, from which the place is not hidden."""
    distance, side = float(np.linalg.norm(place.centre - camera.centre)), _PROBE_PX
    stride = distance * np.tan(np.radians(2 * SMALL_ANGLE_DEG))
    right, down = camera.world_to_camera[0, :3], camera.world_to_camera[1, :3]
    for word, way in (("left", -right), ("right", right), ("higher", -down)):
        eye = camera.centre + stride * way
        pose = look_at(eye, place.centre, up=-down)
        probe = Camera(side, side, side, side, side / 2, side / 2, pose)
        depth = float(np.median(render(splats, probe, backend=backend).depth[46:50, 46:50]))
        if depth > 0.9 * float(np.linalg.norm(place.centre - eye)):
            return word
    return ""
