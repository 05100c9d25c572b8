"""Connectivity of a model: its weakest cut in the graph of photographs that share points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

_SMALLEST_PART = 0.1  # of the photographs; a few outer ones may be weakly connected


@dataclass(frozen=True)
class Cut:
    """A cut into two parts. points: observed in both; views: photographs of the smaller part."""

    points: int
    views: tuple[int, ...]


def weakest_cut(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int, fewest: int = 3
) -> Cut:
    """The cut with the fewest points in common, among cuts along the second eigenvector of the
    normalised Laplacian of the view graph (Fiedler 1973; Shi and Malik 2000).

    Args:
        points, views: [O] observations.
        photographs: of the model.
        fewest: photographs of the smaller part, at least; and at least a tenth of all.

    If the model is too small to be cut: all points, and no views.
    """
    count = int(points.max(initial=-1)) + 1
    smallest = max(fewest, round(_SMALLEST_PART * photographs))
    if photographs < 2 * smallest:
        return Cut(count, ())
    shared = _shared(points, views, photographs)
    root = 1.0 / np.sqrt(np.maximum(shared.sum(axis=1), 1e-9))
    order = np.argsort(np.linalg.eigh(-root[:, None] * shared * root)[1][:, 1] * root)
    rank = np.empty(photographs, np.int64)
    rank[order] = np.arange(photographs)
    first, last = np.full(count, photographs), np.full(count, -1)
    np.minimum.at(first, points, rank[views])
    np.maximum.at(last, points, rank[views])
    observed = last >= 0
    change = np.bincount(first[observed], minlength=photographs).astype(np.int64)
    change -= np.bincount(last[observed], minlength=photographs)
    shared_points = np.cumsum(change)[smallest - 1 : photographs - smallest]
    cut = smallest + int(shared_points.argmin())
    part = order[:cut] if 2 * cut <= photographs else order[cut:]
    return Cut(int(shared_points.min()), tuple(sorted(part.tolist())))


def _shared(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int
) -> NDArray[np.float64]:
    """[V, V] number of points that two photographs both observe."""
    shape = (photographs, int(points.max(initial=-1)) + 1)
    observes = csr_array((np.ones(len(points), np.bool_), (views, points)), shape).astype(
        np.float64
    )
    shared = np.asarray((observes @ observes.T).todense())
    np.fill_diagonal(shared, 0.0)
    return shared
