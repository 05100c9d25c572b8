"""Splats to start from where structure from motion found no points.

Plain walls, carpets out of focus and the rim of a capture have no features, so a start from the
sparse cloud alone leaves holes that training fills slowly or never. Here each photograph is cut
into cells; a cell in which no point lands gets one, at the depth that its neighbours in that
photograph suggest and in the photograph's own colour. Photographs are taken in turn, and what one
has filled counts for the next, so that a few thousand points cover everything that was seen. Beyond
its rim a photograph is continued a little in the colours of the rim: what no photograph shows is
better guessed than left as a hole.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.photos.load import load_image
from stages.scene import Camera, View

CELLS = 32  # along the longer side of a photograph
MARGIN = 0.25  # of the longer side: how far beyond its rim a photograph is continued
NEIGHBOURS = 4
PLANE_POINTS = 12
PLANE_MISFIT = 0.04  # of the inverse depth, root mean square
PLANE_REACH = 1.5  # how far beyond its points' depths a plane is continued
CLEARANCE = 0.5
SCALE = 0.5  # of a cell's size, seen at the point's depth


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
    clear = [(camera.centre, _clearance(camera, points)) for camera in cameras]
    added = [np.zeros((0, 3))]
    colours, scales = [np.zeros((0, 3), np.float32)], [np.zeros(0)]
    for view in sorted(views, key=lambda v: v.name):
        small = view.camera.fitted(CELLS)
        margin = round(MARGIN * CELLS)
        camera = _widened(small, margin)
        pixels, _ = _seen(camera, np.concatenate([points, *added]))
        measured = _thinned(*_seen(camera, points))
        empty = _empty_cells(camera, pixels)
        if len(measured[1]) < PLANE_POINTS or len(empty) == 0:
            continue
        depth = _interpolated(empty, *measured)
        places = _unprojected(camera, empty, depth)
        free = np.ones(len(places), bool)
        for centre, distance in clear:
            free &= np.linalg.norm(places - centre, axis=1) > distance
        places, empty, depth = places[free], empty[free], depth[free]
        added.append(places)
        picture = load_image(folder / view.image, small.width, small.height)
        columns, rows = np.floor(empty).astype(int).T - margin
        rows, columns = rows.clip(0, small.height - 1), columns.clip(0, small.width - 1)
        colours.append(picture[rows, columns])
        scales.append(SCALE * depth / camera.fx)
    return np.concatenate(added), np.concatenate(colours), np.concatenate(scales)


def _clearance(camera: Camera, points: NDArray[np.float64]) -> float:
    """How far around a camera nothing is to be guessed: half of the depth at which it begins to
    see something (the fifth percentile: a few measured points are always misplaced)."""
    _, depths = _seen(camera, points)
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


def _seen(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(pixels [K, 2], depths [K]) of the points that land in the picture."""
    pixels, z = camera.project(points)
    inside = (z > 1e-6) & camera.shows(pixels)
    return pixels[inside], z[inside]


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
    columns, rows = np.floor(pixels).astype(int).T
    hits[rows, columns] = True
    rows, columns = np.nonzero(~hits)
    return np.asarray(np.stack([columns, rows], 1) + 0.5, np.float64)


def _interpolated(
    at: NDArray[np.float64], pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] depth at each place, from the nearest measured points.

    The inverse depth of a plane is affine in the picture: where the nearest points lie on a plane,
    it is continued (a floor, a wall). Elsewhere the largest of the very nearest depths is taken:
    what has no texture is more often behind than before, and a splat too far hides nothing.
    """
    distance2 = ((at[:, None] - pixels[None]) ** 2).sum(2)
    nearest = np.argpartition(distance2, PLANE_POINTS - 1, axis=1)[:, :PLANE_POINTS]
    by_distance = np.argsort(np.take_along_axis(distance2, nearest, 1), axis=1, kind="stable")
    nearest = np.take_along_axis(nearest, by_distance, 1)
    inverse = 1.0 / depths[nearest]
    offset = pixels[nearest] - at[:, None]
    design = np.concatenate([np.ones_like(offset[..., :1]), offset], 2)
    weights = 1.0 / (1.0 + np.take_along_axis(distance2, nearest, 1))[..., None]
    normal = np.einsum("kpi,kpj->kij", design * weights, design) + 1e-9 * np.eye(3)
    right = np.einsum("kpi,kp->ki", design * weights, inverse)
    plane = np.linalg.solve(normal, right[..., None])[..., 0]
    misfit = np.einsum("kpi,ki->kp", design, plane) - inverse
    flat = np.sqrt((misfit**2).mean(1)) < PLANE_MISFIT * inverse.mean(1)
    low, high = inverse.min(1) / PLANE_REACH, inverse.max(1) * PLANE_REACH
    far = inverse[:, :NEIGHBOURS].min(1)
    return np.asarray(1.0 / np.where(flat, np.clip(plane[:, 0], low, high), far), np.float64)


def _unprojected(
    camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    rays = np.stack(
        [
            (pixels[:, 0] - camera.cx) / camera.fx,
            (pixels[:, 1] - camera.cy) / camera.fy,
            np.ones(len(pixels)),
        ],
        1,
    )
    at = rays * depths[:, None] - camera.world_to_camera[:3, 3]
    return np.asarray(at @ camera.world_to_camera[:3, :3], np.float64)
