"""Exposure and white balance of each photograph, and vignetting of each camera, from points that
several photographs show.

Each of them adds to the logarithm of an sRGB value plus 0.055 (`scene.light`). So one linear system
gives them all: a point that is near the centre of one photograph and near the border of another is
an equation for vignetting.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median
from scipy.sparse import csr_array, hstack

from stages.base.stage import Report
from stages.cameras.colmap import read_model
from stages.scene import Camera, Reconstruction
from stages.scene.light import OFFSET, POWER, powers_of_radius, spread_ev
from stages.sfm.finish import SPARSE

DOWNSCALE = 4  # of the pictures' sides; averages out their noise
DARKEST, LIGHTEST = 0.06, 0.94  # sRGB values that are used
REGULARISATION = 1e-6  # x the largest diagonal element; draws unconstrained views towards 0
FEWEST_POINTS = 30  # of a photograph
ITERATIONS = 8  # of reweighted least squares
FEWEST_VIEWS = 4  # of a camera whose vignetting is measured
LEAST_CORNER_EV = 0.15  # of vignetting
LEAST_AGREEMENT = 0.75  # of vignetting fitted to one side of the picture, x that of all sides


@dataclass(frozen=True)
class MeasuredLight:
    """What `measure_light` measures, in EV.

    Args:
        light: [V, 3] by how much each photograph is lighter than the median one in red, green and
            blue; NaN for a view with too few usable points.
        explained: how much of the variance of a point's values over its views disappears when they
            are corrected by `light`: 1 for all of it. Low for surfaces that shine. Variance is
            measured by median absolute deviations.
        vignetting: [V, 3] of the camera of each view (`scene.light`); 0 where none was found.
        vignetting_explained: how much of the variance that is left then disappears when vignetting
            is corrected, too.
    """

    light: NDArray[np.float64]
    explained: float
    vignetting: NDArray[np.float64]
    vignetting_explained: float = 0.0


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light` and `View.vignetting`, measured at the points of its
    COLMAP model, and the share of the points' scatter that the light explains. Training decides
    whether they are corrected."""
    _, _, observed = read_model(reconstruction.folder / SPARSE)
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    found = measure_light(
        pictures,
        [view.camera for view in reconstruction.views],
        observed.points,
        observed.views,
        observed.px,
        tick=lambda done: report.progress(done, len(pictures), "measuring light"),
    )
    lights = [
        None if math.isnan(red) else (red, green, blue)
        for red, green, blue in found.light.round(4).tolist()
    ]
    report.metric("light_spread_ev", round(spread_ev(lights), 4))
    report.metric("light_explained", round(found.explained, 4))
    report.metric("vignetting_ev", round(float(found.vignetting.sum(axis=1).max()), 4))
    report.metric("vignetting_explained", round(found.vignetting_explained, 4))
    views = (
        replace(view, light=light, vignetting=(k1, k2, k3) if k1 + k2 + k3 else None)
        for view, light, (k1, k2, k3) in zip(
            reconstruction.views, lights, found.vignetting.round(4).tolist(), strict=True
        )
    )
    explained = round(found.explained, 4)
    return replace(reconstruction, views=tuple(views), light_explained=explained)


def measure_light(
    pictures: Sequence[Path],
    cameras: Sequence[Camera],
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    px: NDArray[np.float64],
    tick: Callable[[int], None] = lambda done: None,
) -> MeasuredLight:
    """Exposure, white balance and vignetting.

    Args:
        pictures: [V] files.
        cameras: [V] of them; those with the same intrinsics have the same vignetting.
        points, views, px: [O], [O], [O, 2] observations, in pixels of the picture.
        tick: called after each picture, with how many are done.
    """
    values = _values(pictures, views, px, tick)
    usable = ((values > DARKEST) & (values < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= FEWEST_POINTS
    light, vignetting = np.full((len(pictures), 3), np.nan), np.zeros((len(pictures), 3))
    if not usable.any():
        return MeasuredLight(light, 0.0, vignetting)
    points, views, values, px = points[usable], views[usable], values[usable], px[usable]
    ev = POWER * np.log2(values.astype(np.float64) + OFFSET)
    place = np.array([(c.cx, c.cy, math.hypot(c.width, c.height) / 2) for c in cameras])[views]
    place = (px - place[:, :2]) / place[:, 2:]
    vignetting = _vignetting(points, views, ev.mean(axis=1), place, _numbers_of_cameras(cameras))
    darker = (powers_of_radius((place**2).sum(axis=1)) * vignetting[views]).sum(axis=1)
    vignetted, ev = ev, ev + darker[:, None]
    seen, shown = np.unique(views), _indicators(views, len(pictures))
    offsets = np.array([_solution(points, channel, shown) for channel in ev.T]).T
    light[seen] = offsets[seen] - np.median(offsets[seen], axis=0)
    before, after = _variance(points, ev), _variance(points, ev - light[views])
    uncorrected = _variance(points, vignetted - light[views])
    return MeasuredLight(
        light,
        1.0 - after / before if before else 0.0,
        vignetting,
        1.0 - after / uncorrected if uncorrected else 0.0,
    )


def _numbers_of_cameras(cameras: Sequence[Camera]) -> NDArray[np.intp]:
    """[V] equal numbers for equal intrinsics."""
    intrinsics = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras]
    return np.unique(intrinsics, axis=0, return_inverse=True)[1].ravel()


def _vignetting(
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    ev: NDArray[np.float64],
    place: NDArray[np.float64],
    cameras: NDArray[np.intp],
) -> NDArray[np.float64]:
    """[V, 3] vignetting of each view. 0 for a camera where it is small, and where the halves of the
    pictures (left and right, upper and lower) disagree about it: then it is shading of the scene.

    Args:
        points, views, ev: [O] observations and their values.
        place: [O, 2] from the principal point, in half diagonals of the picture.
        cameras: [V] the number of each view's camera.
    """
    found = np.zeros((len(cameras), 3))
    shown = _indicators(views, len(cameras))
    powers = powers_of_radius((place**2).sum(axis=1))
    seen = np.unique(views)
    for camera in np.flatnonzero(np.bincount(cameras[seen]) >= FEWEST_VIEWS):
        mine = cameras[views] == camera
        design = hstack([shown, csr_array(-powers * mine[:, None])])
        coefficients = _solution(points, ev, design, bounded=3)[-3:]
        if coefficients.sum() < LEAST_CORNER_EV:
            continue
        darker = powers @ coefficients * mine
        agreement = []
        for axis in range(2):
            halves = darker[:, None] * np.stack([place[:, axis] < 0, place[:, axis] >= 0], 1)
            agreement += [*_solution(points, ev, hstack([shown, csr_array(-halves)]))[-2:]]
        if min(agreement) >= LEAST_AGREEMENT:
            found[cameras == camera] = coefficients
    return found


def _indicators(views: NDArray[np.int32], count: int) -> csr_array:
    """[O, count] with a one where the observation is of the view."""
    return csr_array((np.ones(len(views)), (np.arange(len(views)), views)), (len(views), count))


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


def _solution(
    points: NDArray[np.int32], ev: NDArray[np.float64], design: csr_array, bounded: int = 0
) -> NDArray[np.float64]:
    """[N] the x with which `ev - design @ x` agrees best at each point.

    Iteratively reweighted least squares (Cauchy weights); the values of points are eliminated
    (Schur complement). Outliers are points that shine or are hidden.

    Args:
        points, ev: [O] observations.
        design: [O, N].
        bounded: how many of the last elements of x are at least 0.
    """
    _, point = np.unique(points, return_inverse=True)
    count, design = int(point.max()) + 1, csr_array(design)
    weight, x = np.ones(len(ev)), np.zeros(design.shape[1])
    for _ in range(ITERATIONS):
        weighted = csr_array(design.multiply(weight[:, None]))
        total = np.bincount(point, weight, count)
        to_points = csr_array((1.0 / total[point], (point, np.arange(len(ev)))), (count, len(ev)))
        table = csr_array(to_points @ weighted)  # [P, N] weighted means of each point
        normal = (design.T @ weighted).todense() - (
            table.T @ csr_array(table.multiply(total[:, None]))
        ).todense()
        mean = np.bincount(point, weight * ev) / total
        right = weighted.T @ (ev - mean[point])
        x = _bounded_solution(np.asarray(normal), right, bounded)
        residual = ev - design @ x
        residual -= (np.bincount(point, weight * residual) / total)[point]
        noise = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (2.0 * noise)) ** 2)
    return x


def _bounded_solution(
    normal: NDArray[np.float64], right: NDArray[np.float64], bounded: int
) -> NDArray[np.float64]:
    """The solution of normal equations whose last `bounded` elements are at least 0: the most
    negative of them becomes 0 until none is negative."""
    normal[np.diag_indices(len(right))] += REGULARISATION * normal.diagonal().max()
    free, x = np.ones(len(right), bool), np.zeros(len(right))
    while True:
        x[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free])
        if not bounded or x[-bounded:].min() >= 0:
            return x
        least = len(right) - bounded + int(np.argmin(x[-bounded:]))
        free[least], x[least] = False, 0.0
