"""The distance between neighbouring splats: the unit in which errors of positions are seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SAMPLE = 20_000  # centres whose nearest neighbour is searched


def median_spacing(means: NDArray[np.floating]) -> float:
    """The median distance of a centre of means [N, 3] to its nearest neighbour, of centres that
    coincide with no other; 0 if there are no such centres. A sample of the centres is searched
    for, among all."""
    from scipy.spatial import cKDTree

    if len(means) < 2:
        return 0.0
    sample = means[:: max(1, len(means) // _SAMPLE)]
    distances = cKDTree(means).query(sample, 2)[0][:, 1]
    apart = distances[distances > 0]
    return float(np.median(apart)) if len(apart) else 0.0
