"""Exposure and white balance of each photograph, from points that several photographs show.

Exposure and white balance add to the logarithm of an sRGB value plus 0.055 (`scene.light`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median
from scipy.sparse import csr_array

from stages.base.stage import Report
from stages.cameras.colmap import read_model
from stages.scene import Reconstruction
from stages.scene.light import OFFSET, POWER, spread_ev
from stages.structure.finish import SPARSE

DOWNSCALE = 4  # of the pictures' sides; averages out their noise
DARKEST, LIGHTEST = 0.06, 0.94  # sRGB values that are used
REGULARISATION = 1e-6  # x the largest diagonal element; draws unconstrained views towards 0
FEWEST_POINTS = 30  # of a photograph
ITERATIONS = 8  # of reweighted least squares


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light`, measured at the points of its COLMAP model, and the
    share of the points' scatter that it explains. Training decides whether it is corrected."""
    model = read_model(reconstruction.folder / SPARSE)[1]
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    found, explained = measure_light(
        pictures,
        model.observed_points,
        model.observing_views,
        model.observed_px,
        tick=lambda done: report.progress(done, len(pictures), "measuring light"),
    )
    lights = [
        None if math.isnan(red) else (red, green, blue)
        for red, green, blue in found.round(4).tolist()
    ]
    report.metric("light_spread_ev", round(spread_ev(lights), 4))
    report.metric("light_explained", round(explained, 4))
    views = (replace(v, light=light) for v, light in zip(reconstruction.views, lights, strict=True))
    return replace(reconstruction, views=tuple(views), light_explained=round(explained, 4))


def measure_light(
    pictures: Sequence[Path],
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[int], None] = lambda done: None,
) -> tuple[NDArray[np.float64], float]:
    """(light [V, 3], explained): by how many EV each photograph is lighter than the median one in
    red, green and blue, NaN for a view with too few usable points; and by which share the variance
    of a point's values over its views falls when they are corrected by it (robust: of the median
    absolute deviations). Exposure explains most of it; of surfaces that shine it explains little.

    Args:
        pictures: [V] files.
        points, views, px: [O], [O], [O, 2] observations, in pixels of the picture.
        tick: called after each picture, with how many are done.
    """
    values = _values(pictures, views, px, tick)
    usable = ((values > DARKEST) & (values < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= FEWEST_POINTS
    points, views, values = points[usable], views[usable], values[usable]
    light = np.full((len(pictures), 3), np.nan)
    if not len(points):
        return light, 0.0
    ev = POWER * np.log2(values.astype(np.float64) + OFFSET)
    seen = np.unique(views)
    offsets = np.array([_offsets(points, views, channel, len(pictures)) for channel in ev.T]).T
    light[seen] = offsets[seen] - np.median(offsets[seen], axis=0)
    before, after = _variance(points, ev), _variance(points, ev - light[views])
    return light, 1.0 - after / before if before else 0.0


def _variance(points: NDArray[np.int32], ev: NDArray[np.float64]) -> float:
    """Sum over channels of the squared median absolute deviation of `ev` [O, 3] from the median of
    each point."""
    ids, point = np.unique(points, return_inverse=True)
    middle = np.stack([median(channel, point, np.arange(len(ids)))[point] for channel in ev.T], 1)
    return float((np.median(np.abs(ev - middle), axis=0) ** 2).sum())


def _values(
    pictures: Sequence[Path],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[int], None],
) -> NDArray[np.float32]:
    """[O, 3] sRGB values of each observation, 0 to 1; NaN outside the picture."""
    found = np.full((len(views), 3), np.nan, np.float32)
    for number, path in enumerate(pictures):
        tick(number + 1)
        mine = np.flatnonzero(views == number)
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is None or not len(mine):
            continue
        height, width = (max(1, side // DOWNSCALE) for side in picture.shape[:2])
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        scale = np.array([width / picture.shape[1], height / picture.shape[0]])
        x, y = np.nan_to_num(px[mine] * scale - 0.5, nan=-1.0).astype(np.float32).T
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        seen = cv2.remap(small, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0]
        found[mine[inside]] = seen[inside] / np.float32(255)
    return found


def _offsets(
    points: NDArray[np.int32], views: NDArray[np.int32], ev: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """[count] offset of each view such that values minus offsets agree best at each point.

    Iteratively reweighted least squares (Cauchy weights) in offsets; the values of points are
    eliminated (Schur complement). Outliers are points that shine or are hidden.
    """
    _, point = np.unique(points, return_inverse=True)
    weight, offsets = np.ones(len(ev)), np.zeros(count)
    for _ in range(ITERATIONS):
        table = csr_array((weight, (point, views)), shape=(int(point.max()) + 1, count))
        total = np.asarray(table.sum(axis=1)).ravel()
        mean = np.bincount(point, weight * ev) / total
        normal = np.diag(np.bincount(views, weight, count)) - np.asarray(
            (table.T @ (table / total[:, None])).todense()
        )
        right = np.bincount(views, weight * (ev - mean[point]), count)
        normal[np.diag_indices(count)] += REGULARISATION * normal.diagonal().max()
        offsets = np.linalg.solve(normal, right)
        residual = ev - offsets[views]
        residual -= (np.bincount(point, weight * residual) / total)[point]
        noise = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (2.0 * noise)) ** 2)
    return offsets
