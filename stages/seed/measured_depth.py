"""Points from measured depth, where structure from motion and the plane sweep found none.

The maps are in metres, the world often is not. So all maps are scaled by one factor: the median
ratio of the sparse points' depths to the depths measured at their pixels. A map that still differs
from the points is not used. Left out are pixels at edges, which mix two surfaces, and positions
that another map sees through. Where several maps measure the same surface, their mean is used.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.base.text import listed
from stages.scene import View
from stages.scene.pictures import load_depth, load_image, mask_of
from stages.seed.plane_sweep import SOLID, DepthMap, best_per_cell
from stages.seed.projection import cells, pixel_centres, unproject, visible_points

FEWEST_POINTS = 10  # sparse points by which a map is compared
CONTRADICTS = 0.1  # median relative difference between a map and the sparse points in it
EDGE = 0.05  # relative difference between neighbouring pixels: another surface, or a grazing one
SAME_SURFACE = 0.05  # relative difference between two maps: several times a sensor's noise
CELLS = 64  # along the longer side of a map: at most one point in each


def measured_points(
    folder: Path, views: tuple[View, ...], points: NDArray[np.float64], report: Report
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(points [M, 3], colours [M, 3] in 0..1) to add to `points` [P, 3].

    Args:
        folder: folder that the views' image and depth paths are relative to.
        views: those without a depth map add nothing.
        points: sparse points and those of the plane sweep.
        report: receives metrics, and warnings that name maps that are not used.
    """
    ordered = [view for view in sorted(views, key=lambda view: view.name) if view.depth]
    maps = _scaled([_load(folder, view) for view in ordered], ordered, points, report)
    positions, colours = [points], [np.zeros((0, 3), np.float32)]
    for number, depth_map in maps.items():
        others = [other for name, other in maps.items() if name != number]
        found, support = _fused(depth_map, others)
        known = np.where(depth_map.depth > 0, depth_map.depth, np.float32(np.inf))
        scored, size = DepthMap(depth_map.camera, known, support), max(support.shape) / CELLS
        rows, columns = best_per_cell(scored, support > 0, np.concatenate(positions), size)
        positions.append(found[rows, columns])
        camera = depth_map.camera
        picture = load_image(folder / ordered[number].image, camera.width, camera.height)
        colours.append(picture[rows, columns])
    return np.concatenate([np.zeros((0, 3)), *positions[1:]]), np.concatenate(colours)


def _load(folder: Path, view: View) -> DepthMap:
    """The view's map without masked pixels; `ncc` is 1 where it is measured and not at an edge."""
    depth = load_depth(folder / view.depth)
    height, width = depth.shape
    mask = mask_of(folder, view, width, height)
    if mask is not None:
        depth = np.where(mask < SOLID, np.float32(0), depth)
    window = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), window)
    inner = (depth > 0) & (cv2.dilate(depth, window) / (1 + EDGE) < nearest)
    return DepthMap(view.camera.resized(width, height), depth, inner.astype(np.float32))


def _scaled(
    maps: list[DepthMap], views: list[View], points: NDArray[np.float64], report: Report
) -> dict[int, DepthMap]:
    """The maps that agree with the points, in world units, by their place in `maps`."""
    ratios = []
    for one in maps:
        _, pixels, depths = visible_points(one.camera, points)
        measured = one.depth[cells(pixels)]
        ratios.append(depths[measured > 0] / measured[measured > 0])
    known = [float(np.median(ratio)) for ratio in ratios if len(ratio) >= FEWEST_POINTS]
    scale = float(np.median(known)) if known else 0.0
    wrong = [
        not known
        or (
            len(ratio) >= FEWEST_POINTS
            and float(np.median(np.abs(ratio / scale - 1))) > CONTRADICTS
        )
        for ratio in ratios
    ]
    if any(wrong):
        names = [view.name for view, bad in zip(views, wrong, strict=True) if bad]
        report.warn(
            "seed-depth-contradicts",
            "Depth maps are not used where they differ by more than a tenth from the points that "
            f"the photographs show: {listed(names)}. Check that they belong to these photographs, "
            "and hold depth along the camera's axis.",
        )
    report.metric("depth_maps", len(maps) - sum(wrong))
    report.metric("depth_scale", scale)
    return {
        i: replace(one, depth=one.depth * np.float32(scale))
        for i, one in enumerate(maps)
        if not wrong[i]
    }


def _fused(
    one: DepthMap, others: list[DepthMap]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(mean position [h, w, 3] over the maps that measure the surface at each pixel, their number
    [h, w]). The number is 0 where this map has no value, or where another sees through it."""
    rows, columns = np.nonzero(one.ncc > 0)
    depths = one.depth[rows, columns].astype(np.float64)
    own = unproject(one.camera, pixel_centres(rows, columns), depths)
    total, count, free = own.copy(), np.ones(len(own), np.float32), np.ones(len(own), bool)
    for other in others:
        seen, pixels, depths = visible_points(other.camera, own)
        at = cells(pixels)
        sure, measured = other.ncc[at] > 0, other.depth[at].astype(np.float64)
        ratio = depths / np.where(sure, measured, np.inf)
        free[seen[sure & (ratio < 1 - SAME_SURFACE)]] = False
        same = np.abs(ratio - 1) < SAME_SURFACE
        total[seen[same]] += unproject(other.camera, pixel_centres(*at)[same], measured[same])
        count[seen[same]] += 1
    position, support = np.zeros((*one.depth.shape, 3)), np.zeros_like(one.depth)
    position[rows, columns] = total / count[:, None]
    support[rows, columns] = np.where(free, count, 0)
    return position, support
