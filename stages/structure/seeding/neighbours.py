"""Distances to nearest neighbours, exact and deterministic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.kernels.simd import kernel


def mean_neighbour_distance(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """[N] mean distance of each point [N, 3] to its `count` nearest others.

    Duplicates are neighbours at distance 0. With fewer than `count` others the mean is over all of
    them; a single point gives infinity. Points must be finite.
    """
    count = min(count, len(points) - 1)
    if count < 1:
        return np.full(len(points), np.inf)
    # Sweeping along the axis of the largest spread leaves the fewest candidates.
    spread = np.percentile(points, 90, axis=0) - np.percentile(points, 10, axis=0)
    axis = int(np.argmax(spread))
    order = np.argsort(points[:, axis], kind="stable")
    result = np.empty(len(points))
    result[order] = _sweep(np.ascontiguousarray(points[order], np.float64), axis, count)
    return result


@kernel
def _sweep(points: NDArray[np.float64], axis: int, count: int) -> NDArray[np.float64]:
    """For points sorted along `axis`: search outwards on both sides until the next candidate is
    farther away along that axis alone than the `count`th nearest so far."""
    n = len(points)
    result = np.empty(n)
    best = np.empty(count)
    for i in range(n):
        best[:] = np.inf
        low, high = i - 1, i + 1
        while low >= 0 or high < n:
            below = points[i, axis] - points[low, axis] if low >= 0 else np.inf
            above = points[high, axis] - points[i, axis] if high < n else np.inf
            if min(below, above) ** 2 > best[count - 1]:
                break
            if below <= above:
                j = low
                low -= 1
            else:
                j = high
                high += 1
            square = 0.0
            for k in range(3):
                square += (points[i, k] - points[j, k]) ** 2
            slot = count - 1
            if square >= best[slot]:
                continue
            while slot > 0 and best[slot - 1] > square:
                best[slot] = best[slot - 1]
                slot -= 1
            best[slot] = square
        total = 0.0
        for k in range(count):
            total += np.sqrt(best[k])
        result[i] = total / count
    return result


def nearest_distance(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] distance of each point [N, 3] to the nearest of `others` [M, 3] (few)."""
    nearest = np.full(len(points), np.inf)
    for other in others:
        nearest = np.minimum(nearest, np.linalg.norm(points - other, axis=1))
    return nearest
