"""Matches of two photographs: mutual nearest neighbours that pass the ratio test (Lowe 2004)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.kernels.simd import kernel
from stages.sfm.worker.vocabulary import FeatureIndex

RATIO = 0.8  # of the angles to the nearest and the second nearest, as in COLMAP
LARGEST_ANGLE = 0.7  # radians, as in COLMAP
_SQUARED_LENGTH = 512.0**2  # of a descriptor


def match_descriptors(first: FeatureIndex, second: FeatureIndex) -> NDArray[np.uint32]:
    """[M, 2] indices of features that match, sorted; each feature is in one match at most."""
    there = _nearest(first, np.arange(len(first.rows)), second)
    candidates = np.flatnonzero(there >= 0)
    queried = np.unique(there[candidates])
    back = np.full(len(second.rows), -1, np.int64)
    back[queried] = _nearest(second, queried, first)
    mutual = candidates[back[there[candidates]] == candidates]
    pairs = np.stack([first.rows[mutual], second.rows[there[mutual]]], axis=1)
    return pairs[np.argsort(pairs[:, 0])].astype(np.uint32)


def _nearest(
    queries: FeatureIndex, queried: NDArray[np.int64], targets: FeatureIndex
) -> NDArray[np.int64]:
    """[A] position in `targets` of the nearest neighbour of each feature in `queried` [A], or -1 if
    it fails the ratio test."""
    best = np.empty(len(queried), np.int64)
    dots = np.empty((len(queried), 2), np.int32)
    _search(
        queries.descriptors[queried],
        queries.probes[queried],
        targets.descriptors,
        targets.starts,
        best,
        dots,
    )
    angles = np.arccos(np.minimum(dots / _SQUARED_LENGTH, 1.0))
    best[(angles[:, 0] > LARGEST_ANGLE) | (angles[:, 0] >= RATIO * angles[:, 1])] = -1
    return best


@kernel
def _search(queries, probes, targets, starts, best, dots):
    """The two largest dot products of each query with the targets under its probed words, in
    integers, so that every machine finds the same."""
    for query in range(len(queries)):
        nearest, largest, next_largest = -1, np.int64(0), np.int64(0)
        for word in probes[query]:
            for target in range(starts[word], starts[word + 1]):
                total = np.uint32(0)  # 32 bits throughout take half the time of 64
                for k in range(queries.shape[1]):
                    product = np.uint16(queries[query, k]) * np.uint16(targets[target, k])
                    total = np.uint32(total + np.uint32(product))
                dot = np.int64(total)
                if dot > largest:
                    nearest, largest, next_largest = target, dot, largest
                elif dot > next_largest:
                    next_largest = dot
        best[query], dots[query, 0], dots[query, 1] = nearest, largest, next_largest
