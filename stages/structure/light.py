"""How much lighter or darker, and in which tint, each photograph was taken: from the spots that
several photographs show.

What light means to sRGB values is said in `scene.light`: exposure and white balance add to the
logarithm of a value and 0.055.
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

SMALLER = 4  # times: sides of the pictures that are looked at; averages out their noise
DARKEST, LIGHTEST = 0.06, 0.94  # sRGB values between which light can be told
HOLD = 1e-6  # of the best-known view: holds each towards 0, where nothing else does
ALIKE = 0.5  # of the spread: by more, halves of the spots do not tell the same light
LEAST = 30  # spots of a photograph to tell its light by
HALVES = 5  # all spots; the greyer and the more tinted; the darker and the lighter
TURNS = 8  # of weighing spots that do not agree (they shine, or are hidden) ever less


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light`, from the COLMAP model that lies in its folder; as it is
    where its spots tell different things: then a surface shines, and the light did not change."""
    model = read_model(reconstruction.folder / SPARSE)[1]
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    observed = model.observed_points, model.observing_views, model.observed_px
    steps, total = itertools.count(1), len(pictures) + HALVES * 3
    found, differ = measure_light(
        pictures, *observed, tick=lambda: report.progress(next(steps), total, "measuring light")
    )
    lights = [
        None if math.isnan(red) else (red, green, blue)
        for red, green, blue in found.round(4).tolist()
    ]
    spread = spread_ev(lights)
    report.metric("light_spread_ev", round(spread, 4))
    report.metric("light_disagreement_ev", round(differ, 4))
    if differ > ALIKE * spread:
        return reconstruction
    views = (replace(v, light=light) for v, light in zip(reconstruction.views, lights, strict=True))
    return replace(reconstruction, views=tuple(views))


def measure_light(
    pictures: Sequence[Path],
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[], None] = lambda: None,
) -> tuple[NDArray[np.float64], float]:
    """([V, 3] EV by which each photograph is lighter than the median one, for red, green and blue;
    by how many EV, root mean square, halves of the spots differ in that: the greyer and the more
    tinted, the darker and the lighter).

    pictures [V]: files. points, views [O], px [O, 2]: where each view sees which spot, in pixels of
    its picture. NaN for a view with too few usable spots. tick: called after each picture, and
    after each channel of each of `HALVES`.
    """
    spots = _values(pictures, views, px, tick)
    usable = ((spots > DARKEST) & (spots < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= LEAST
    points, views, spots = points[usable], views[usable], spots[usable]
    if not len(points):
        return np.full((len(pictures), 3), np.nan), 0.0
    ev = POWER * np.log2(spots.astype(np.float64) + OFFSET)
    tint = (spots.max(axis=1) - spots.min(axis=1)) / spots.max(axis=1)
    halves = [np.ones(len(points), np.bool_)]
    for kind in (tint, spots.mean(axis=1)):
        _, spot = np.unique(points, return_inverse=True)
        of_spot = (np.bincount(spot, kind) / np.bincount(spot))[spot]
        halves += [of_spot < np.median(of_spot), of_spot >= np.median(of_spot)]
    light, *told = (_even(points[h], views[h], ev[h], len(pictures), tick) for h in halves)
    differ = np.array([told[0] - told[1], told[2] - told[3]])
    return light, float(np.sqrt(np.nanmean(differ**2))) if np.isfinite(differ).any() else 0.0


def _even(
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    ev: NDArray[np.float64],
    count: int,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """[count, 3] of each view, its channels' medians 0; NaN for views without spots."""
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
    """[O, 3] sRGB values at each spot, 0 to 1; NaN beyond a picture."""
    found = np.full((len(views), 3), np.nan, np.float32)
    for number, path in enumerate(pictures):
        tick()
        mine = np.flatnonzero(views == number)
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is None or not len(mine):
            continue
        height, width = (max(1, side // SMALLER) for side in picture.shape[:2])
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
    """[count] what to take from each view's values so that they agree best spot by spot; robust."""
    _, spot = np.unique(points, return_inverse=True)
    weight, offsets = np.ones(len(ev)), np.zeros(count)
    for _ in range(TURNS):
        table = csr_array((weight, (spot, views)), shape=(int(spot.max()) + 1, count))
        total = np.asarray(table.sum(axis=1)).ravel()
        mean = np.bincount(spot, weight * ev) / total
        normal = np.diag(np.bincount(views, weight, count)) - np.asarray(
            (table.T @ (table / total[:, None])).todense()
        )
        right = np.bincount(views, weight * (ev - mean[spot]), count)
        normal[np.diag_indices(count)] += HOLD * normal.diagonal().max()
        offsets = np.linalg.solve(normal, right)
        left = ev - offsets[views]
        left -= (np.bincount(spot, weight * left) / total)[spot]
        noise = max(1.4826 * float(np.median(np.abs(left))), 1e-6)
        weight = 1.0 / (1.0 + (left / (2.0 * noise)) ** 2)
    return offsets
