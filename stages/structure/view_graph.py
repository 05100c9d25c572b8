"""How firmly the photographs of a model hang together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

_SMALLEST_PART = 0.1  # of the photographs; a few at the rim may hang loosely


@dataclass(frozen=True)
class Cut:
    """What holds two parts of a model together: points seen from both; views: the smaller part."""

    points: int
    views: tuple[int, ...]


def weakest_cut(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int, fewest: int = 3
) -> Cut:
    """The cut through the model that severs fewest points, neither part being small.

    points, views [O]: who sees what. Looked for where photographs are sorted by the second
    eigenvector of their graph, along which parts come apart (Fiedler 1973; Shi and Malik 2000).
    Where the model is too small to be cut: all points, and no views.
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
    seen = last >= 0
    steps = np.bincount(first[seen], minlength=photographs).astype(np.int64)
    steps -= np.bincount(last[seen], minlength=photographs)
    severed = np.cumsum(steps)[smallest - 1 : photographs - smallest]
    cut = smallest + int(severed.argmin())
    part = order[:cut] if 2 * cut <= photographs else order[cut:]
    return Cut(int(severed.min()), tuple(sorted(part.tolist())))


def _shared(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int
) -> NDArray[np.float64]:
    """[V, V] points that each two photographs both see."""
    shared = np.zeros((photographs, photographs))
    starts = np.flatnonzero(np.diff(points, prepend=-1, append=-1))
    for start, end in pairwise(starts.tolist()):
        mine = views[start:end]
        shared[mine[:, None], mine] += 1.0
    np.fill_diagonal(shared, 0.0)
    return shared
