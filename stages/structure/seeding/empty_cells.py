"""Splats to start from where structure from motion found no points.

Plain walls, carpets out of focus and the rim of a capture have no features, so a start from the
sparse cloud alone leaves holes that training fills slowly or never. Here each photograph is cut
into cells; a cell in which no point lands gets one, at the depth that its neighbours in that
photograph suggest and in the photograph's own colour. Photographs are taken in turn, and what one
has filled counts for the next, so that a few thousand points cover everything that was seen.

A guess too near is worse than none: training dresses it in what the one photograph shows behind
it, and it hangs as a cloud before all cameras that look past it. So other photographs are asked
(`witnesses`), and what they do not confirm goes as far back as the photograph sees at all: there it
hides nothing, and leaves no hole for a cloud to grow into.

Beyond its rim a photograph is continued a little in the colours of the rim, but only to where no
photograph looks: what none shows is better guessed than left as a hole, and what one shows is not
to be guessed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.photos.load import load_image, mask_of
from stages.scene import Camera, View
from stages.structure.seeding.projection import cells, pixel_centres, unproject, visible_points
from stages.structure.seeding.visibility import VisibilityConstraints

CELLS = 32  # along the longer side of a photograph
MARGIN = 0.25  # of the longer side: how far beyond its rim a photograph is continued
PLANE_POINTS = 12
PLANE_MISFIT = 0.04  # of the inverse depth, root mean square
PLANE_REACH = 1.5  # how far beyond its points' depths a plane is continued
CLEARANCE = 0.5
SCALE = 0.5  # of a cell's size, seen at the point's depth
SOLID = 250  # of 255: less of a cell holds what a mask takes away
FARTHEST = 95  # percentile of the depths that a photograph sees


@dataclass
class _Filling:
    """What is known (points [P, 3], and the clear space around each camera) and what was added."""

    points: NDArray[np.float64]
    clear: list[tuple[NDArray[np.float64], float]]
    places: list[NDArray[np.float64]] = field(default_factory=lambda: [np.zeros((0, 3))])
    colours: list[NDArray[np.float32]] = field(
        default_factory=lambda: [np.zeros((0, 3), np.float32)]
    )
    scales: list[NDArray[np.float64]] = field(default_factory=lambda: [np.zeros(0)])


def fill_cells(
    folder: Path,
    views: tuple[View, ...],
    points: NDArray[np.float64],
    cameras: tuple[Camera, ...] = (),
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """(points [M, 3], colours [M, 3] in 0..1, scales [M] in world units) to add to `points`.

    folder: where the views' image paths start. cameras: all that were found, those of `views`
    among them; the space before a camera is empty, and stays so.
    """
    filling = _Filling(points, [(c.centre, _clearance(c, points)) for c in cameras])
    witnesses = VisibilityConstraints(views, points)
    ordered = sorted(views, key=lambda v: v.name)
    for view in ordered:
        _fill(filling, folder, view, 0, witnesses, ordered)
    for view in ordered:
        _fill(filling, folder, view, round(MARGIN * CELLS), witnesses, ordered)
    return (
        np.concatenate(filling.places),
        np.concatenate(filling.colours),
        np.concatenate(filling.scales),
    )


def _fill(
    filling: _Filling,
    folder: Path,
    view: View,
    margin: int,
    witnesses: VisibilityConstraints,
    views: list[View],
) -> None:
    """Fill the empty cells of one photograph; with a margin, those beyond its rim."""
    small = view.camera.fitted(CELLS)
    camera = _widened(small, margin)
    _, pixels, _ = visible_points(camera, np.concatenate([filling.points, *filling.places]))
    measured = _thinned(*visible_points(camera, filling.points)[1:])
    empty = _empty_cells(camera, pixels)
    if len(measured[1]) < PLANE_POINTS or len(empty) == 0:
        return
    depth = _interpolated(empty, *measured)
    if margin:
        free = ~_in_a_picture(unproject(camera, empty, depth), views)
    else:
        depth, free = _believed(view, camera, empty, depth, measured[1], witnesses)
    places = unproject(camera, empty, depth)
    for centre, distance in filling.clear:
        free &= np.linalg.norm(places - centre, axis=1) > distance
    picture = load_image(folder / view.image, small.width, small.height)
    rows, columns = cells(empty - margin)
    at = rows.clip(0, small.height - 1), columns.clip(0, small.width - 1)
    mask = mask_of(folder, view, small.width, small.height)
    if mask is not None:
        free &= mask[at] > SOLID
    filling.places.append(places[free])
    filling.colours.append(picture[at][free])
    filling.scales.append(SCALE * depth[free] / camera.fx)


def _believed(
    view: View,
    camera: Camera,
    at: NDArray[np.float64],
    depth: NDArray[np.float64],
    measured: NDArray[np.float64],
    witnesses: VisibilityConstraints,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(depth [K], whether to fill [K]): what nothing confirms is moved back to where the
    photograph's view ends, if no other contradicts that."""
    places = unproject(camera, at, depth)
    believed = witnesses.confirm(places, view.name) & witnesses.anchored(places)
    end = float(np.percentile(measured, FARTHEST))
    behind = np.where(believed, depth, np.maximum(depth, end))
    _, before = witnesses.ask(unproject(camera, at, behind), view.name)
    return behind, believed | ((before == 0) & (behind > depth))


def _in_a_picture(places: NDArray[np.float64], views: list[View]) -> NDArray[np.bool_]:
    """[K] whether some photograph looks there."""
    shown = np.zeros(len(places), bool)
    for view in views:
        shown[visible_points(view.camera, places)[0]] = True
    return shown


def _clearance(camera: Camera, points: NDArray[np.float64]) -> float:
    """How far around a camera nothing is to be guessed: half of the depth at which it begins to
    see something (the fifth percentile: a few measured points are always misplaced)."""
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


def _thinned(
    pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most one point in each quarter of a cell: a depth wants no more, and 25,000 take long."""
    quarter = np.floor(2 * pixels).astype(np.int64)
    _, first = np.unique(quarter[:, 1] * 100_000 + quarter[:, 0], return_index=True)
    return pixels[first], depths[first]


def _empty_cells(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """[K, 2] centres of the cells (the camera's pixels) in which no point lands."""
    hits = np.zeros((camera.height, camera.width), bool)
    hits[cells(pixels)] = True
    return pixel_centres(*np.nonzero(~hits))


def _interpolated(
    at: NDArray[np.float64], pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] depth at each place, from the nearest measured points.

    The inverse depth of a plane is affine in the picture: where the nearest points lie on a plane,
    it is continued (a floor, a wall). Elsewhere the farthest of the nearest points to all four
    sides is taken: what has no texture is more often behind than before, and a splat too far hides
    nothing.
    """
    offset = pixels[None] - at[:, None]
    distance2 = (offset**2).sum(2)
    nearest = np.argpartition(distance2, PLANE_POINTS - 1, axis=1)[:, :PLANE_POINTS]
    by_distance = np.argsort(np.take_along_axis(distance2, nearest, 1), axis=1, kind="stable")
    nearest = np.take_along_axis(nearest, by_distance, 1)
    inverse = 1.0 / depths[nearest]
    near = np.take_along_axis(offset, nearest[..., None], 1)
    design = np.concatenate([np.ones_like(near[..., :1]), near], 2)
    weights = 1.0 / (1.0 + np.take_along_axis(distance2, nearest, 1))[..., None]
    normal = np.einsum("kpi,kpj->kij", design * weights, design) + 1e-9 * np.eye(3)
    right = np.einsum("kpi,kp->ki", design * weights, inverse)
    plane = np.linalg.solve(normal, right[..., None])[..., 0]
    misfit = np.einsum("kpi,ki->kp", design, plane) - inverse
    flat = np.sqrt((misfit**2).mean(1)) < PLANE_MISFIT * inverse.mean(1)
    low, high = inverse.min(1) / PLANE_REACH, inverse.max(1) * PLANE_REACH
    on_plane = 1.0 / np.clip(plane[:, 0], low, high)
    return np.where(flat, on_plane, _farthest_around(offset, distance2, depths))


def _farthest_around(
    offset: NDArray[np.float64], distance2: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] the largest depth among the nearest point in each quadrant. offset [K, P, 2]."""
    quadrant = 2 * (offset[..., 0] > 0) + (offset[..., 1] > 0)
    farthest = np.zeros(len(offset))
    for number in range(4):
        among = np.where(quadrant == number, distance2, np.inf)
        nearest = among.argmin(1)
        found = np.isfinite(np.take_along_axis(among, nearest[:, None], 1)[:, 0])
        farthest = np.where(found, np.maximum(farthest, depths[nearest]), farthest)
    return farthest
