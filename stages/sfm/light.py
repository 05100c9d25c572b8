"""Exposure and white balance of each photograph, and vignetting of each camera, from points that
several photographs show.

Each of them adds to the logarithm of an sRGB value plus 0.055 (`scene.light`). So one linear system
gives them all: a point that is near the centre of one photograph and near the border of another is
an equation for vignetting.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median
from scipy.sparse import csr_array, hstack

from stages.base.stage import Report
from stages.cameras.colmap import Observations, read_model
from stages.scene import Camera, Reconstruction
from stages.scene.light import NOISE_EV, OFFSET, POWER, powers_of_radius
from stages.sfm.finish import SPARSE

DOWNSCALE = 4  # of the pictures' sides; averages out their noise
DARKEST, LIGHTEST = 0.06, 0.94  # sRGB values that are used
REGULARISATION = 1e-6  # x the largest diagonal element; draws unconstrained views towards 0
FEWEST_POINTS = 30  # of a photograph
ITERATIONS = 8  # of reweighted least squares
FEWEST_VIEWS = 4  # of a camera whose vignetting is measured
LEAST_CORNER_EV = 0.15  # of vignetting
LEAST_AGREEMENT = 0.75  # of vignetting fitted to one side of the picture, x that of all sides
LEAST_VIGNETTING_EXPLAINED = 0.01  # of the variance of points that exposure leaves
LEAST_EXPLAINED = 0.5  # of the variance of a point's values over its views


@dataclass(frozen=True)
class Change:
    """Exposure or white balance, as far as photographs differ in it.

    Args:
        spread_ev: root mean square over photographs, EV.
        explained: how much of the variance of a point's values over its views disappears when this
            is corrected: 1 for all of it. Low for surfaces that shine. Variance is measured by
            median absolute deviations.
        disagreement_ev: root mean square, over photographs and the octants of the scene around its
            median point, by which an octant differs from the whole. A camera that changes its
            exposure changes all parts of a picture; a lamp on a turning object does not.
    """

    spread_ev: float = 0.0
    explained: float = 0.0
    disagreement_ev: float = 0.0

    @property
    def supported(self) -> bool:
        """Whether the camera changed, and not what it shows."""
        enough = self.explained >= LEAST_EXPLAINED and self.spread_ev > NOISE_EV
        return enough and self.disagreement_ev < self.spread_ev


@dataclass(frozen=True)
class MeasuredLight:
    """What `measure_light` measures.

    Args:
        light: [V, 3] by how many EV each photograph is lighter than the median one in red, green
            and blue, as far as `exposure` and `white_balance` are supported; NaN for a view with
            too few usable points.
        exposure: the mean over the channels.
        white_balance: the channels' differences from their mean.
        vignetting: [V, 3] of the camera of each view, EV (`scene.light`); 0 where none was found.
        vignetting_explained: how much of the variance that light leaves disappears when vignetting
            is corrected.
    """

    light: NDArray[np.float64]
    exposure: Change
    white_balance: Change
    vignetting: NDArray[np.float64]
    vignetting_explained: float = 0.0


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light` and `View.vignetting`, measured at the points of its
    COLMAP model."""
    _, cloud, observed = read_model(reconstruction.folder / SPARSE)
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    found = measure_light(
        pictures,
        [view.camera for view in reconstruction.views],
        cloud.points,
        observed,
        tick=lambda done: report.progress(done, len(pictures), "measuring light"),
    )
    lights = [
        None if math.isnan(red) else (red, green, blue)
        for red, green, blue in found.light.round(4).tolist()
    ]
    for name in ("exposure", "white_balance"):
        change = {key: round(value, 4) for key, value in asdict(getattr(found, name)).items()}
        report.metric(name, change | {"supported": getattr(found, name).supported})
    report.metric("vignetting_ev", round(float(found.vignetting.sum(axis=1).max()), 4))
    report.metric("vignetting_explained", round(found.vignetting_explained, 4))
    views = (
        replace(view, light=light, vignetting=(k1, k2, k3) if k1 + k2 + k3 else None)
        for view, light, (k1, k2, k3) in zip(
            reconstruction.views, lights, found.vignetting.round(4).tolist(), strict=True
        )
    )
    return replace(reconstruction, views=tuple(views))


def measure_light(
    pictures: Sequence[Path],
    cameras: Sequence[Camera],
    positions: NDArray[np.float64],
    observed: Observations,
    tick: Callable[[int], None] = lambda done: None,
) -> MeasuredLight:
    """Exposure, white balance and vignetting.

    Args:
        pictures: [V] files.
        cameras: [V] of them; those with the same intrinsics have the same vignetting.
        positions: [P, 3] of the points.
        observed: which of them are seen where.
        tick: called after each picture, with how many are done.
    """
    points, views, px = observed.points, observed.views, observed.px
    values = _values(pictures, views, px, tick)
    usable = ((values > DARKEST) & (values < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= FEWEST_POINTS
    vignetting = np.zeros((len(pictures), 3))
    if not usable.any():
        return MeasuredLight(np.full(vignetting.shape, np.nan), Change(), Change(), vignetting)
    points, views, values, px = points[usable], views[usable], values[usable], px[usable]
    taken = POWER * np.log2(values.astype(np.float64) + OFFSET)
    place = np.array([(c.cx, c.cy, math.hypot(c.width, c.height) / 2) for c in cameras])[views]
    place = (px - place[:, :2]) / place[:, 2:]
    vignetting = _vignetting(points, views, taken.mean(axis=1), place, _numbers_of_cameras(cameras))
    darker = (powers_of_radius((place**2).sum(axis=1)) * vignetting[views]).sum(axis=1)[:, None]
    light = _offsets(points, views, taken + darker, len(pictures))[views]
    left, without = (_variance(points, ev - light) for ev in (taken + darker, taken))
    explained = 1.0 - left / without if without else 0.0
    if explained < LEAST_VIGNETTING_EXPLAINED:
        vignetting, darker, explained = np.zeros_like(vignetting), np.zeros_like(darker), 0.0
    ev = taken + darker
    grey = ev.mean(axis=1, keepdims=True)
    octants = (positions > np.median(positions, axis=0))[points] @ np.array([1, 2, 4])
    exposure, lighter = _change(points, views, grey, octants, len(pictures))
    white_balance, tinted = _change(points, views, ev - grey, octants, len(pictures))
    light = exposure.supported * lighter + white_balance.supported * tinted
    return MeasuredLight(light, exposure, white_balance, vignetting, explained)


def _change(
    points: NDArray[np.int32],
    views: NDArray[np.int32],
    ev: NDArray[np.float64],
    octants: NDArray[np.intp],
    count: int,
) -> tuple[Change, NDArray[np.float64]]:
    """How photographs differ in `ev` [O, C], and by how much each does [count, C], which is NaN
    where too few points are seen. octants [O]: of the observed points."""
    offsets = _offsets(points, views, ev, count)
    apart = []
    for octant in range(8):
        here = octants == octant
        if here.any():
            apart.append(_offsets(points[here], views[here], ev[here], count) - offsets)
    differs = np.any(np.abs(offsets) > NOISE_EV, axis=1)[views]
    before, after = _variance(points, ev, differs), _variance(points, ev - offsets[views], differs)
    explained = 1.0 - after / before if before else 0.0
    return Change(_rms(offsets), explained, _rms(np.array(apart))), offsets


def _rms(values: NDArray[np.float64]) -> float:
    """Root mean square of those that are known; 0 if none is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0


def _offsets(
    points: NDArray[np.int32], views: NDArray[np.int32], ev: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """[count, C] by how much each photograph is lighter than the median one; NaN where it shows
    fewer than `FEWEST_POINTS`. ev: [O, C]."""
    found = np.array([_solution(points, channel, _indicators(views, count)) for channel in ev.T]).T
    found[np.bincount(views, minlength=count) < FEWEST_POINTS] = np.nan
    return found - np.nanmedian(found, axis=0) if np.isfinite(found).any() else found


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


def _variance(
    points: NDArray[np.int32], ev: NDArray[np.float64], where: NDArray[np.bool_] | None = None
) -> float:
    """Sum over channels of the squared median absolute deviation of `ev` [O, C] from the median of
    each point. where: [O] the deviations that count; None for all."""
    ids, point = np.unique(points, return_inverse=True)
    middle = np.stack([median(channel, point, np.arange(len(ids)))[point] for channel in ev.T], 1)
    away = np.abs(ev - middle)[slice(None) if where is None else where]
    return float((np.median(away, axis=0) ** 2).sum()) if len(away) else 0.0


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
