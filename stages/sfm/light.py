"""Exposure and white balance of each photograph, from points that several photographs show.

A change of either adds to the logarithm of an sRGB value plus 0.055 (`scene.light`), so one linear
system gives those of all photographs.
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
from scipy.sparse import csr_array

from stages.base.stage import Report
from stages.cameras.colmap import Observations, read_model
from stages.scene import Reconstruction
from stages.scene.light import NOISE_EV, OFFSET, POWER
from stages.sfm.finish import SPARSE

DOWNSCALE = 4  # of the pictures' sides; averages out their noise
DARKEST, LIGHTEST = 0.06, 0.94  # sRGB values that are used
REGULARISATION = 1e-6  # x the largest diagonal element; draws unconstrained views towards 0
FEWEST_POINTS = 30  # of a photograph
ITERATIONS = 8  # of reweighted least squares
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
    """

    light: NDArray[np.float64]
    exposure: Change
    white_balance: Change


def with_light(reconstruction: Reconstruction, report: Report) -> Reconstruction:
    """The reconstruction with `View.light`, measured at the points of its COLMAP model."""
    _, cloud, observed = read_model(reconstruction.folder / SPARSE)
    pictures = [reconstruction.folder / view.image for view in reconstruction.views]
    found = measure_light(
        pictures,
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
    views = (
        replace(view, light=light) for view, light in zip(reconstruction.views, lights, strict=True)
    )
    return replace(reconstruction, views=tuple(views))


def measure_light(
    pictures: Sequence[Path],
    positions: NDArray[np.float64],
    observed: Observations,
    tick: Callable[[int], None] = lambda done: None,
) -> MeasuredLight:
    """Exposure and white balance.

    Args:
        pictures: [V] files.
        positions: [P, 3] of the points.
        observed: which of them are seen where.
        tick: called after each picture, with how many are done.
    """
    points, views, px = observed.points, observed.views, observed.px
    values = _values(pictures, views, px, tick)
    usable = ((values > DARKEST) & (values < LIGHTEST)).all(axis=1)
    counts = np.bincount(views[usable], minlength=len(pictures))
    usable &= counts[views] >= FEWEST_POINTS
    if not usable.any():
        return MeasuredLight(np.full((len(pictures), 3), np.nan), Change(), Change())
    points, views, values = points[usable], views[usable], values[usable]
    ev = POWER * np.log2(values.astype(np.float64) + OFFSET)
    grey = ev.mean(axis=1, keepdims=True)
    octants = (positions > np.median(positions, axis=0))[points] @ np.array([1, 2, 4])
    exposure, lighter = _change(points, views, grey, octants, len(pictures))
    white_balance, tinted = _change(points, views, ev - grey, octants, len(pictures))
    light = exposure.supported * lighter + white_balance.supported * tinted
    return MeasuredLight(light, exposure, white_balance)


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
    found = np.array([_solution(points, views, channel, count) for channel in ev.T]).T
    found[np.bincount(views, minlength=count) < FEWEST_POINTS] = np.nan
    return found - np.nanmedian(found, axis=0) if np.isfinite(found).any() else found


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
        if not len(mine):
            continue
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is None:
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
    points: NDArray[np.int32], views: NDArray[np.int32], ev: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """[count] the offset of each view with which `ev - offset` agrees best at each point.

    Iteratively reweighted least squares (Cauchy weights); the values of points are eliminated
    (Schur complement). Outliers are points that shine or are hidden. points, views, ev: [O].
    """
    _, point = np.unique(points, return_inverse=True)
    weight, offsets = np.ones(len(ev)), np.zeros(count)
    for _ in range(ITERATIONS):
        total = np.bincount(point, weight)
        seen = csr_array((weight, (point, views)), (len(total), count))  # [P, count]
        normal = np.diag(np.bincount(views, weight, count))
        normal -= (seen.T @ csr_array(seen.multiply(1.0 / total[:, None]))).toarray()
        largest = normal.diagonal().max()
        if largest <= REGULARISATION:  # no point is seen by two views
            return offsets
        normal[np.diag_indices(count)] += REGULARISATION * largest
        mean = np.bincount(point, weight * ev) / total
        right = np.bincount(views, weight * (ev - mean[point]), count)
        offsets = np.linalg.solve(normal, right)
        residual = ev - offsets[views]
        residual -= (np.bincount(point, weight * residual) / total)[point]
        noise = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (2.0 * noise)) ** 2)
    return offsets
