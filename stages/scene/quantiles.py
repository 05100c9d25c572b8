"""Statistics of many points: quantiles, one axis at a time to save memory, and their spacing."""

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
    """The median distance from a centre of means [N, 3] to its nearest neighbour: errors of
    positions are visible in units of it. Centres that coincide with another do not count; 0 if none
    is left. The median is over a sample of the centres."""
    if len(means) < 2:
        return 0.0
    sample = means[:: max(1, len(means) // _SAMPLE)]
    distances = cKDTree(means).query(sample, 2)[0][:, 1]
    apart = distances[distances > 0]
    return float(np.median(apart)) if len(apart) else 0.0
