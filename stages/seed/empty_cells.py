"""Initial splats where structure from motion found no points.

Bare walls, blurred backgrounds and the borders of a capture have no features, so a start from the
sparse points alone leaves holes that training fills slowly or never. Here each photograph is
divided into cells. A cell without points gets one, at a depth interpolated from its neighbours in
that photograph and in its own colour. Photographs are processed in order, and points added for one
count for the next, so that a few thousand points cover everything that was seen.

A depth that is too small is worse than a hole: training fits the splat to what one photograph shows
behind it, and it becomes a floater in front of other cameras. So other photographs must support the
position (`visibility`). Without support it is moved to the far end of the photograph's depths,
where it occludes little, and leaves no hole for floaters to grow into. If other photographs show
other colours there, it is moved to where they contradict least (`colour_evidence`).

Beyond its borders a photograph is extrapolated a little in the colours of the border, but only to
where no photograph looks.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.scene import Camera, View
from stages.seed.colour_evidence import CELLS, SmallPicture, depths_by_colour
from stages.seed.projection import cells, pixel_centres, unproject, visible_points
from stages.seed.visibility import VisibilityConstraints

MARGIN = 0.25  # of the longer side: how far a photograph is extrapolated beyond its borders
PLANE_POINTS = 12
PLANE_RESIDUAL = 0.04  # RMS, relative to the inverse depth
PLANE_EXTENT = 1.5  # factor on the range of depths in which a plane is extrapolated
CLEARANCE = 0.5  # x the near depth of a camera: no point is added within
SCALE = 0.5  # of a cell's size at the depth of the point
FAR_PERCENTILE = 95  # of the depths of a photograph's points


@dataclass
class _Filling:
    """Given points [P, 3], the clearance around each camera and the photographs by name of view;
    and the splats added so far."""

    points: NDArray[np.float64]
    clearances: list[tuple[NDArray[np.float64], float]]
    pictures: dict[str, SmallPicture]
    positions: list[NDArray[np.float64]] = field(default_factory=lambda: [np.zeros((0, 3))])
    colours: list[NDArray[np.float32]] = field(
        default_factory=lambda: [np.zeros((0, 3), np.float32)]
    )
    scales: list[NDArray[np.float64]] = field(default_factory=lambda: [np.zeros(0)])


def fill_cells(
    folder: Path,
    views: tuple[View, ...],
    points: NDArray[np.float64],
    cameras: tuple[Camera, ...] = (),
    training: tuple[View, ...] = (),
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """(points [M, 3], colours [M, 3] in 0..1, scales [M] in world units) to add to `points`.

    Args:
        folder: folder that the views' image paths are relative to.
        views: training views whose cells are filled.
        points: [P, 3].
        cameras: of all views; no point is added close to them.
        training: all training views, `views` if left out: beyond its borders a photograph is
            extrapolated only to where none of them looks.
    """
    ordered = sorted(views, key=lambda v: v.name)
    pictures = {view.name: SmallPicture.of(folder, view, points) for view in ordered}
    filling = _Filling(points, [(c.centre, _clearance(c, points)) for c in cameras], pictures)
    visibility = VisibilityConstraints(views, points)
    for view in ordered:
        _fill(filling, view, 0, visibility, training or views)
    for view in ordered:
        _fill(filling, view, round(MARGIN * CELLS), visibility, training or views)
    return (
        np.concatenate(filling.positions),
        np.concatenate(filling.colours),
        np.concatenate(filling.scales),
    )


def _fill(
    filling: _Filling,
    view: View,
    margin: int,
    visibility: VisibilityConstraints,
    training: tuple[View, ...],
) -> None:
    """Fill the empty cells of one photograph, also those in a margin (cells) beyond its borders."""
    own = filling.pictures[view.name]
    camera = _widened(own.camera, margin)
    _, pixels, _ = visible_points(camera, np.concatenate([filling.points, *filling.positions]))
    sampled = _one_per_quarter_cell(*visible_points(camera, filling.points)[1:])
    empty = _empty_cells(camera, pixels)
    rows, columns = cells(empty - margin)
    at = rows.clip(0, own.camera.height - 1), columns.clip(0, own.camera.width - 1)
    solid = own.solid[at]
    empty, at = empty[solid], (at[0][solid], at[1][solid])
    if len(sampled[1]) < PLANE_POINTS or len(empty) == 0:
        return
    depth = _interpolated(empty, *sampled)
    if margin:
        free = ~_in_any_picture(unproject(camera, empty, depth), training)
    else:
        depth, free = _supported_depth(filling, own, empty, depth, sampled[1], visibility)
    positions = unproject(camera, empty, depth)
    for centre, distance in filling.clearances:
        free &= np.linalg.norm(positions - centre, axis=1) > distance
    if not free.any():
        return
    filling.positions.append(positions[free])
    filling.colours.append(own.colours[at][free])
    filling.scales.append(SCALE * depth[free] / camera.fx)


def _supported_depth(
    filling: _Filling,
    own: SmallPicture,
    at: NDArray[np.float64],
    depth: NDArray[np.float64],
    depths: NDArray[np.float64],
    visibility: VisibilityConstraints,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(depth [K], whether to fill [K]): positions without support are moved to the far end of the
    photograph's `depths`, or to where the colours of other photographs contradict that less, if no
    points of another photograph do."""
    positions = unproject(own.camera, at, depth)
    supported = visibility.supported(positions, own.name)
    supported &= visibility.close_to_points(positions)
    moved, filled = depth.copy(), supported.copy()
    rows = np.flatnonzero(~supported)
    far = np.maximum(depth[rows], np.percentile(depths, FAR_PERCENTILE))
    others = [picture for picture in filling.pictures.values() if picture is not own]
    moved[rows] = depths_by_colour(own, others, at[rows], depth[rows], far)
    _, occluding = visibility.count(unproject(own.camera, at[rows], moved[rows]), own.name)
    filled[rows] = occluding == 0
    return moved, filled


def _in_any_picture(positions: NDArray[np.float64], views: tuple[View, ...]) -> NDArray[np.bool_]:
    """[K] whether a position projects into any photograph."""
    shown = np.zeros(len(positions), bool)
    for view in views:
        shown[visible_points(view.camera, positions)[0]] = True
    return shown


def _clearance(camera: Camera, points: NDArray[np.float64]) -> float:
    """Distance around a camera without added points: half of the depth at which it begins to see
    something (the fifth percentile of depths: a few points are always misplaced)."""
    _, _, depths = visible_points(camera, points)
    return CLEARANCE * float(np.percentile(depths, 5)) if len(depths) else 0.0


def _widened(camera: Camera, margin: int) -> Camera:
    """The camera with `margin` more pixels on every side."""
    return replace(
        camera,
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
    )


def _one_per_quarter_cell(
    pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most one point per quarter of a cell: enough for depths, and 25,000 points take long."""
    quarter = np.floor(2 * pixels).astype(np.int64)
    _, first = np.unique(quarter[:, 1] * 100_000 + quarter[:, 0], return_index=True)
    return pixels[first], depths[first]


def _empty_cells(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """[K, 2] centres of the cells (the camera's pixels) without points."""
    hits = np.zeros((camera.height, camera.width), bool)
    hits[cells(pixels)] = True
    return pixel_centres(*np.nonzero(~hits))


def _interpolated(
    at: NDArray[np.float64], pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] depth at each pixel `at`, from the nearest sparse points.

    The inverse depth of a plane is affine in the picture: if the nearest points lie on a plane, it
    is extrapolated (a floor, a wall). Otherwise the largest depth among the nearest points of the
    four quadrants is used: surfaces without texture are more often behind than in front, and a
    splat that is too far occludes nothing.
    """
    distance, nearest = cKDTree(pixels).query(at, PLANE_POINTS)
    inverse = 1.0 / depths[nearest]
    design = np.concatenate([np.ones((*nearest.shape, 1)), pixels[nearest] - at[:, None]], 2)
    weights = 1.0 / (1.0 + distance**2)[..., None]
    normal = np.einsum("kpi,kpj->kij", design * weights, design) + 1e-9 * np.eye(3)
    right = np.einsum("kpi,kp->ki", design * weights, inverse)
    plane = np.linalg.solve(normal, right[..., None])[..., 0]
    residual = np.einsum("kpi,ki->kp", design, plane) - inverse
    flat = np.sqrt((residual**2).mean(1)) < PLANE_RESIDUAL * inverse.mean(1)
    low, high = inverse.min(1) / PLANE_EXTENT, inverse.max(1) * PLANE_EXTENT
    depth: NDArray[np.float64] = 1.0 / np.clip(plane[:, 0], low, high)
    depth[~flat] = _farthest_around(at[~flat], pixels, depths)
    return depth


def _farthest_around(
    at: NDArray[np.float64], pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] the largest depth among the nearest point in each quadrant around each pixel `at`."""
    offset = pixels[None] - at[:, None]
    distance2 = (offset**2).sum(2)
    quadrant = 2 * (offset[..., 0] > 0) + (offset[..., 1] > 0)
    farthest = np.zeros(len(offset))
    for number in range(4):
        among = np.where(quadrant == number, distance2, np.inf)
        nearest = among.argmin(1)
        found = np.isfinite(np.take_along_axis(among, nearest[:, None], 1)[:, 0])
        farthest = np.where(found, np.maximum(farthest, depths[nearest]), farthest)
    return farthest
