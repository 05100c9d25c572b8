"""Splats to start from where structure from motion found no points.

Plain walls, carpets out of focus and the rim of a capture have no features, so a start from the
sparse cloud alone leaves holes that training fills slowly or never. Here each photograph is cut
into cells; a cell in which no point lands gets one, at the depth that its neighbours in that
photograph suggest and in the photograph's own colour. Photographs are taken in turn, and what one
has filled counts for the next, so that a few thousand points cover everything that was seen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.photos.load import load_image
from stages.scene import Camera, View

CELLS = 32  # along the longer side of a photograph
NEIGHBOURS = 4
SCALE = 0.5  # of a cell's size, seen at the point's depth


def fill_cells(
    folder: Path, views: tuple[View, ...], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """(points [M, 3], colours [M, 3] in 0..1, scales [M] in world units) to add to `points`.

    folder: where the views' image paths start.
    """
    added = [np.zeros((0, 3))]
    colours, scales = [np.zeros((0, 3), np.float32)], [np.zeros(0)]
    for view in sorted(views, key=lambda v: v.name):
        camera = view.camera.fitted(CELLS)
        pixels, depths = _seen(camera, np.concatenate([points, *added]))
        measured = _seen(camera, points)
        empty = _empty_cells(camera, pixels)
        if len(measured[1]) < NEIGHBOURS or len(empty) == 0:
            continue
        depth = _interpolated(empty, *measured)
        added.append(_unprojected(camera, empty, depth))
        picture = load_image(folder / view.image, camera.width, camera.height)
        columns, rows = np.floor(empty).astype(int).T
        colours.append(picture[rows, columns])
        scales.append(SCALE * depth / camera.fx)
    return np.concatenate(added), np.concatenate(colours), np.concatenate(scales)


def _seen(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(pixels [K, 2], depths [K]) of the points that land in the picture."""
    at = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    at = at[at[:, 2] > 1e-6]
    pixels = at[:, :2] / at[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1)
    return pixels[inside], at[inside, 2]


def _empty_cells(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """[K, 2] centres of the cells (the camera's pixels) in which no point lands."""
    hits = np.zeros((camera.height, camera.width), bool)
    columns, rows = np.floor(pixels).astype(int).T
    hits[rows, columns] = True
    rows, columns = np.nonzero(~hits)
    return np.stack([columns, rows], 1) + 0.5


def _interpolated(
    at: NDArray[np.float64], pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[K] depth at each place: the nearest measured points' inverse depths, weighted by 1/d^2."""
    distance2 = ((at[:, None] - pixels[None]) ** 2).sum(2)
    nearest = np.argsort(distance2, axis=1, kind="stable")[:, :NEIGHBOURS]
    weights = 1.0 / (np.take_along_axis(distance2, nearest, 1) + 1e-3)
    inverse = (weights / depths[nearest]).sum(1) / weights.sum(1)
    return np.asarray(1.0 / inverse)


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
    return np.asarray(at @ camera.world_to_camera[:3, :3])
