"""Statistics of a set of splats, and the splats that cause trouble in viewers.

Troublesome splats:
- needle: the longest axis is more than 100 times the second. Its effective rank (Hyung et al. 2024,
  "Effective Rank Analysis and Regularization for Enhanced 3D Gaussian Splatting") is then 1.001 of
  3: a line, which becomes visible from new views. A flat splat is no needle.
- outlier: the centre lies more than 5 times as far out as the box that holds the middle 98 % of the
  coordinates on each axis. A viewer that frames everything then shows the scene as a dot.
- transparent: the opacity is below 1/255, so that it is never drawn.
- no rotation: the quaternion is 0 or too short to be normalised; too large: the squared scale
  exceeds float32. Neither can be drawn.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.row_slices import row_slices
from stages.raster.definition import ALPHA_MIN, LOG_SCALE_MAX, QUATERNION_MIN
from stages.scene import ROW_FIELDS, Splats
from stages.scene.quantiles import quantiles

NEEDLE_ASPECT = 100.0
OUTLIER_BOXES = 5.0
_BOX = {"low": 0.0, "middle_low": 0.01, "median_centre": 0.5, "middle_high": 0.99, "high": 1.0}
_VALUES = ROW_FIELDS[:-1]


@dataclass(frozen=True)
class Statistics:
    """Statistics of splats. Lengths are in world units, relative to the origin of the splats.

    Attributes:
        count: the number of splats.
        by_degree: splats by the SH degree that they use.
        not_finite: by attribute, splats with NaN or infinity. All that follows ignores them.
        whole: the number of the other splats.
        low, high: [3] box of the centres.
        middle_low, middle_high: [3] box of the central 98 % of the coordinates on each axis.
        median_centre: [3] median coordinates.
        median_scale: median standard deviation.
        median_opacity: in 0..1.
        troubles: the number of splats of each kind of trouble, see above.
    """

    count: int
    by_degree: dict[int, int]
    not_finite: dict[str, int]
    whole: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    middle_low: NDArray[np.float64]
    middle_high: NDArray[np.float64]
    median_centre: NDArray[np.float64]
    median_scale: float
    median_opacity: float
    troubles: dict[str, int]


def statistics_of(splats: Splats) -> Statistics:
    """The statistics of `splats`, whose values may be anything, NaN included."""
    degrees, counts = np.unique(splats.sh_degrees, return_counts=True)
    by_degree = {int(d): int(n) for d, n in zip(degrees, counts, strict=True)}
    whole, not_finite = _finite(splats)
    box = dict(zip(_BOX, quantiles(splats.means[whole], tuple(_BOX.values())), strict=True))
    troubles: Counter[str] = Counter()
    for rows in row_slices(len(splats)):
        for name, marks in _troubles(splats.take(rows).take(whole[rows]), box).items():
            troubles[name] += int(np.count_nonzero(marks))
    return Statistics(
        count=len(splats),
        by_degree=by_degree,
        not_finite=not_finite,
        whole=int(np.count_nonzero(whole)),
        **box,
        median_scale=float(np.exp(_median(splats.log_scales[whole]))),
        median_opacity=1 / (1 + float(np.exp(-_median(splats.opacity_logits[whole])))),
        troubles=dict(troubles),
    )


def _finite(splats: Splats) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """([N] whether every value is finite; by attribute, how many splats fail)."""
    whole = np.ones(len(splats), bool)
    failed = dict.fromkeys(_VALUES, 0)
    for rows in row_slices(len(splats)):
        for name in _VALUES:
            values = getattr(splats, name)[rows]
            good = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
            failed[name] += int(np.count_nonzero(~good))
            whole[rows] &= good
    return whole, {name: n for name, n in failed.items() if n}


def _troubles(splats: Splats, box: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.bool_]]:
    """By kind of trouble: [N] which splats have it. All values must be finite."""
    logs = np.sort(splats.log_scales, axis=1)
    middle = (box["middle_low"] + box["middle_high"]) / 2
    half = (box["middle_high"] - box["middle_low"]) / 2
    with np.errstate(over="ignore", divide="ignore"):
        return {
            "needles": logs[:, 2] - logs[:, 1] > np.log(NEEDLE_ASPECT),
            "outliers": (np.abs(splats.means - middle) > OUTLIER_BOXES * half).any(axis=1),
            "transparent": splats.opacities < ALPHA_MIN,
            "no-rotation": np.abs(splats.quaternions).max(axis=1, initial=0.0) < QUATERNION_MIN,
            "too-large": logs[:, 2] > LOG_SCALE_MAX,
        }


def _median(values: NDArray[np.floating]) -> np.float64:
    return np.float64(np.median(values)) if values.size else np.float64(np.nan)
