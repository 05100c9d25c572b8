"""Points by multi-view stereo, where structure from motion found none.

Plane sweep (Collins 1996, "A space-sweep approach to true multi-image matching"): the pictures of a
few source views with a suitable triangulation angle are warped into a reference view by a plane at
each of many depth hypotheses. The depth with the largest normalised cross-correlation (NCC) of
neighbourhoods is the estimate. An estimate is used only if depth maps of other views agree and
visibility constraints support it: about one in 500 is then wrong.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.scene import Camera, View
from stages.scene.pictures import load_image, mask_of
from stages.seed.projection import cells, pixel_centres, unproject, visible_points
from stages.seed.view_selection import Observations
from stages.seed.visibility import VisibilityConstraints

SIDE = 200  # pixels, longer side of the depth maps
PLANES = 64  # depth hypotheses
RADIUS = 3  # of the neighbourhood, pixels
DEPTH_MARGIN = (0.7, 1.6)  # factors on the nearest and farthest depth of sparse points
FLAT = 2e-5  # variance of a neighbourhood without texture: hundredths of 8-bit noise
DEPTH_TOLERANCE = 0.015  # relative
# (NCC, depth maps that must agree): fewer suffice for a larger NCC
AGREEMENT = ((0.6, 3), (0.8, 2))
CELL = 2.0  # pixels: at most one point in each
SOLID = 250  # of 255: least value of the mask
SAME_SURFACE = 0.05  # relative depth difference


@dataclass(frozen=True)
class DepthMap:
    """The depth map of a reference view: depth [H, W], and NCC [H, W], -1 without an estimate."""

    camera: Camera
    depth: NDArray[np.float32]
    ncc: NDArray[np.float32]


def plane_sweep_points(
    folder: Path, views: tuple[View, ...], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(points [M, 3], colours [M, 3] in 0..1) to add to the sparse `points` [P, 3].

    folder: folder that the image paths of `views` are relative to.
    """
    ordered = sorted(views, key=lambda view: view.name)
    cameras = [view.camera.fitted(SIDE) for view in ordered]
    pictures = [
        load_image(folder / view.image, camera.width, camera.height)
        for view, camera in zip(ordered, cameras, strict=True)
    ]
    grey = [np.ascontiguousarray(picture.mean(2), np.float32) for picture in pictures]
    observations = Observations(cameras, points)
    sources = [observations.sources(i) for i in range(len(cameras))]
    with ThreadPoolExecutor(threads.count()) as pool:
        sweep = functools.partial(_sweep, cameras=cameras, grey=grey, points=points)
        depth_maps = list(pool.map(sweep, range(len(cameras)), sources))
    for view, depth_map in zip(ordered, depth_maps, strict=True):
        mask = mask_of(folder, view, depth_map.camera.width, depth_map.camera.height)
        if mask is not None:
            depth_map.ncc[mask < SOLID] = -1
    positions, colours = [points], [np.zeros((0, 3), np.float32)]
    for i, depth_map in enumerate(depth_maps):
        others = [j for j in range(len(depth_maps)) if j in sources[i] or i in sources[j]]
        consistent = _consistent(depth_map, [depth_maps[j] for j in others])
        rows, columns = best_per_cell(depth_map, consistent, np.concatenate(positions))
        at = pixel_centres(rows, columns)
        depths = depth_map.depth[rows, columns].astype(np.float64)
        positions.append(unproject(depth_map.camera, at, depths))
        colours.append(pictures[i][rows, columns])
    more = np.concatenate(positions[1:] or [np.zeros((0, 3))])
    supported = VisibilityConstraints(views, points).supported(more)
    return more[supported], np.concatenate(colours)[supported]


def _sweep(
    i: int,
    sources: list[int],
    cameras: list[Camera],
    grey: list[NDArray[np.float32]],
    points: NDArray[np.float64],
) -> DepthMap:
    """The best depth hypothesis at each pixel, by the mean NCC of the two best source views."""
    camera = cameras[i]
    nothing = np.full((camera.height, camera.width), -1, np.float32)
    depths = visible_points(camera, points)[2]
    if not sources or not len(depths):
        return DepthMap(camera, np.ones_like(nothing), nothing)
    nearest, farthest = np.percentile(depths, (1, 99)) * DEPTH_MARGIN
    inverse = np.linspace(1 / farthest, 1 / nearest, PLANES)
    mean = _box(grey[i])
    variance = np.maximum(_box(grey[i] * grey[i]) - mean * mean, 0)
    scores = np.empty((PLANES, camera.height, camera.width), np.float32)
    for plane, inverse_depth in enumerate(inverse):
        nccs = []
        for j in sources:
            moved, missing = _warped(camera, cameras[j], grey[j], float(inverse_depth))
            mean2 = _box(moved)
            variance2 = np.maximum(_box(moved * moved) - mean2 * mean2, 0)
            covariance = _box(grey[i] * moved) - mean * mean2
            ncc = covariance / np.sqrt((variance + FLAT) * (variance2 + FLAT))
            ncc[missing] = -1
            nccs.append(ncc)
        scores[plane] = _mean_of_best_two(nccs)
    best = scores.argmax(0)
    score = scores.max(0)
    score[(best == 0) | (best == PLANES - 1) | (variance < FLAT / 2)] = -1
    depth = 1 / (inverse[0] + _peak(scores, best) * (inverse[1] - inverse[0]))
    return DepthMap(camera, depth.astype(np.float32), score)


def _mean_of_best_two(values: Sequence[NDArray[np.floating]]) -> NDArray[np.floating]:
    """Pixel by pixel; five times as fast as sorting."""
    best, *others = values
    if not others:
        return best
    second = np.full_like(best, -np.inf)
    for other in others:
        second = np.maximum(second, np.minimum(best, other))
        best = np.maximum(best, other)
    return np.asarray((best + second) / 2)


def _box(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    size = (2 * RADIUS + 1, 2 * RADIUS + 1)
    return np.asarray(cv2.blur(picture, size, borderType=cv2.BORDER_REFLECT), np.float32)


def _warped(
    camera: Camera, other: Camera, picture: NDArray[np.float32], inverse_depth: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(`other`'s picture, warped into `camera` by a fronto-parallel plane; where it has none)."""
    rotation = other.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    shift = other.world_to_camera[:3, 3] - rotation @ camera.world_to_camera[:3, 3]
    plane = rotation + np.outer(shift, (0, 0, inverse_depth))
    warp = _intrinsics(other) @ plane @ np.linalg.inv(_intrinsics(camera))
    beyond = -10.0
    moved = cv2.warpPerspective(
        picture,
        warp,
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderValue=beyond,
    )
    return np.asarray(moved, np.float32), np.asarray(moved < -0.01)


def _intrinsics(camera: Camera) -> NDArray[np.float64]:
    """[3, 3] for OpenCV, which has pixel centres at whole numbers."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def _peak(scores: NDArray[np.float32], best: NDArray[np.intp]) -> NDArray[np.float64]:
    """[H, W] sub-plane index of the best plane: the peak of a parabola through three scores."""
    middle = np.clip(best, 1, PLANES - 2)
    below, at, above = (
        np.take_along_axis(scores, (middle + k)[None], 0)[0].astype(np.float64) for k in (-1, 0, 1)
    )
    bend = np.minimum(below - 2 * at + above, -1e-6)
    return np.asarray(middle + np.clip(0.5 * (below - above) / bend, -1, 1), np.float64)


def _consistent(depth_map: DepthMap, others: list[DepthMap]) -> NDArray[np.bool_]:
    """[H, W] where enough of the other depth maps agree with this one."""
    height, width = depth_map.depth.shape
    rows, columns = np.divmod(np.arange(height * width), width)
    at = pixel_centres(rows, columns)
    positions = unproject(depth_map.camera, at, depth_map.depth.ravel().astype(np.float64))
    consistent = np.zeros(height * width, bool)
    for ncc, wanted in AGREEMENT:
        count = np.zeros(height * width, int)
        for other in others:
            landed, pixels, depths = visible_points(other.camera, positions)
            there = cells(pixels)
            same = np.abs(other.depth[there] / depths - 1) < DEPTH_TOLERANCE
            count[landed] += same & (other.ncc[there] > ncc)
        consistent |= (count >= wanted) & (depth_map.ncc.ravel() > ncc)
    return consistent.reshape(height, width)


def best_per_cell(
    depth_map: DepthMap,
    consistent: NDArray[np.bool_],
    points: NDArray[np.float64],
    size: float = CELL,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(rows, columns) of the consistent pixel with the largest NCC in each cell, of `size` pixels,
    without points.
    Points far in front of or behind a consistent depth are on another surface and do not count."""
    height, width = consistent.shape
    taken = np.zeros((int(height // size) + 1, int(width // size) + 1), bool)
    _, pixels, depths = visible_points(depth_map.camera, points)
    there = cells(pixels)
    same = np.abs(depths / depth_map.depth[there] - 1) < SAME_SURFACE
    rows, columns = cells(pixels[same | ~consistent[there]], size)
    taken[rows, columns] = True
    rows, columns = np.nonzero(consistent)
    down, across = cells(pixel_centres(rows, columns), size)
    cell = down * taken.shape[1] + across
    free = ~taken.ravel()[cell]
    rows, columns, cell = rows[free], columns[free], cell[free]
    order = np.lexsort((-depth_map.ncc[rows, columns], cell))
    _, first = np.unique(cell[order], return_index=True)
    return rows[order][first], columns[order][first]
