"""Distances to nearest neighbours, exact and deterministic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


def mean_neighbour_distance(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """[N] mean distance of each point [N, 3] to its `count` nearest others.

    Duplicates are neighbours at distance 0. With fewer than `count` others the mean is over all of
    them; a single point gives infinity. Points must be finite.
    """
    count = min(count, len(points) - 1)
    if count < 1:
        return np.full(len(points), np.inf)
    distances, _ = cKDTree(points).query(points, np.arange(2, count + 2))  # the first is itself
    return np.asarray(distances.mean(axis=1))


def nearest_distance(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] distance of each point [N, 3] to the nearest of `others` [M, 3]; infinity if M is 0."""
    return np.asarray(cKDTree(others).query(points)[0])
