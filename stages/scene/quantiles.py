"""Quantiles of many points, one axis at a time to save memory.

Also: the distance between neighbouring splats: the unit in which errors of positions are seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


def quantiles(means: NDArray[np.floating], shares: Sequence[float]) -> NDArray[np.float64]:
    """[len(shares), 3] quantiles of the coordinates of means [N, 3], linearly interpolated. Rows
    that are not finite are left out; zeros if none is left."""
    whole = np.isfinite(means).all(axis=1)
    found = np.zeros((len(shares), 3))
    if whole.any():
        for axis in range(3):
            values = means[whole, axis].astype(np.float64)
            found[:, axis] = np.quantile(values, shares, overwrite_input=True)
    return found


_SAMPLE = 20_000  # centres whose nearest neighbour is searched


def median_spacing(means: NDArray[np.floating]) -> float:
    """The median distance of a centre of means [N, 3] to its nearest neighbour, of centres that
    coincide with no other; 0 if there are no such centres. A sample of the centres is searched
    for, among all."""
    if len(means) < 2:
        return 0.0
    sample = means[:: max(1, len(means) // _SAMPLE)]
    distances = cKDTree(means).query(sample, 2)[0][:, 1]
    apart = distances[distances > 0]
    return float(np.median(apart)) if len(apart) else 0.0
