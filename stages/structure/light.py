"""Exposure and white balance of each photograph, from points that several photographs show.

Exposure and white balance add to the logarithm of an sRGB value plus 0.055 (`scene.light`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
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
SUBSETS = 5  # all points; the greyer and the more saturated half; the darker and the lighter half
ITERATIONS = 8  # of reweighted least squares


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light`, measured at the points of its COLMAP model, and the
    disagreement between halves of these points. Training decides whether the light is corrected."""
    model = read_model(reconstruction.folder / SPARSE)[1]
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    observed = model.observed_points, model.observing_views, model.observed_px
    steps, total = itertools.count(1), len(pictures) + SUBSETS * 3
    found, disagreement = measure_light(
        pictures, *observed, tick=lambda: report.progress(next(steps), total, "measuring light")
    )
    lights = [
        None if math.isnan(red) else (red, green, blue)
        for red, green, blue in found.round(4).tolist()
    ]
    report.metric("light_spread_ev", round(spread_ev(lights), 4))
    report.metric("light_disagreement_ev", round(disagreement, 4))
    views = (replace(v, light=light) for v, light in zip(reconstruction.views, lights, strict=True))
    return replace(reconstruction, views=tuple(views), light_disagreement_ev=round(disagreement, 4))


def measure_light(
    pictures: Sequence[Path],
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[], None] = lambda: None,
) -> tuple[NDArray[np.float64], float]:
    """(light [V, 3], disagreement): by how many EV each photograph is lighter than the median one
    in red, green and blue, NaN for a view with too few usable points; and the RMS difference in EV
    between halves of the points: the greyer and the more saturated, the darker and the lighter.

    Args:
        pictures: [V] files.
        points, views, px: [O], [O], [O, 2] observations, in pixels of the picture.
        tick: called after each picture, and after each channel of each of `SUBSETS`.
    """
    values = _values(pictures, views, px, tick)
    usable = ((values > DARKEST) & (values < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= FEWEST_POINTS
    points, views, values = points[usable], views[usable], values[usable]
    if not len(points):
        return np.full((len(pictures), 3), np.nan), 0.0
    ev = POWER * np.log2(values.astype(np.float64) + OFFSET)
    saturation = (values.max(axis=1) - values.min(axis=1)) / values.max(axis=1)
    subsets = [np.ones(len(points), np.bool_)]
    for kind in (saturation, values.mean(axis=1)):
        _, point = np.unique(points, return_inverse=True)
        mean = (np.bincount(point, kind) / np.bincount(point))[point]
        subsets += [mean < np.median(mean), mean >= np.median(mean)]
    light, grey, saturated, dark, bright = (
        _centred_offsets(points[s], views[s], ev[s], len(pictures), tick) for s in subsets
    )
    difference = np.array([grey - saturated, dark - bright])
    if not np.isfinite(difference).any():
        return light, 0.0
    return light, float(np.sqrt(np.nanmean(difference**2)))


def _centred_offsets(
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    ev: NDArray[np.float64],
    count: int,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """[count, 3] `_offsets` of each channel, with median 0; NaN for views without points."""
    found = np.empty((count, 3))
    for channel in range(3):
        found[:, channel] = _offsets(points, views, ev[:, channel], count)
        tick()
    found[np.bincount(views, minlength=count) == 0] = np.nan
    return np.asarray(found - np.nanmedian(found, axis=0))


def _values(
    pictures: Sequence[Path],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[], None],
) -> NDArray[np.float32]:
    """[O, 3] sRGB values of each observation, 0 to 1; NaN outside the picture."""
    found = np.full((len(views), 3), np.nan, np.float32)
    for number, path in enumerate(pictures):
        tick()
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
