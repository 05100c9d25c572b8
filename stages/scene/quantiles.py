"""Quantiles of many points, one axis at a time to save memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


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
