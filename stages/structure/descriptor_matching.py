"""Matches of two photographs: features that are each other's nearest, and clearly so."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.kernels.simd import kernel
from stages.structure.vocabulary import FeatureIndex

RATIO = 0.8  # of the angles to the nearest and to the second (Lowe 2004), as COLMAP has it
LARGEST_ANGLE = 0.7  # radians, as COLMAP has it
_SQUARED_LENGTH = 512.0**2  # of a descriptor


def match_descriptors(first: FeatureIndex, second: FeatureIndex) -> NDArray[np.uint32]:
    """[M, 2] rows of features that match, sorted. Every feature is in one match at most."""
    there = _nearest(first, np.arange(len(first.rows)), second)
    candidates = np.flatnonzero(there >= 0)
    asked = np.unique(there[candidates])
    back = np.full(len(second.rows), -1, np.int64)
    back[asked] = _nearest(second, asked, first)
    mutual = candidates[back[there[candidates]] == candidates]
    pairs = np.stack([first.rows[mutual], second.rows[there[mutual]]], axis=1)
    return pairs[np.argsort(pairs[:, 0])].astype(np.uint32)


def _nearest(
    queries: FeatureIndex, asked: NDArray[np.int64], targets: FeatureIndex
) -> NDArray[np.int64]:
    """[A] place in `targets` of the clearly nearest to each feature that is asked for, or -1."""
    best = np.empty(len(asked), np.int64)
    dots = np.empty((len(asked), 2), np.int32)
    _search(
        queries.descriptors[asked],
        queries.near[asked],
        targets.descriptors,
        targets.starts,
        best,
        dots,
    )
    angles = np.arccos(np.minimum(dots / _SQUARED_LENGTH, 1.0))
    best[(angles[:, 0] > LARGEST_ANGLE) | (angles[:, 0] >= RATIO * angles[:, 1])] = -1
    return best


@kernel
def _search(queries, near, targets, starts, best, dots):
    """The largest two products of each query with the targets under its words; whole numbers, so
    that every machine finds the same."""
    for query in range(len(queries)):
        place, largest, next_largest = -1, np.int64(0), np.int64(0)
        for word in near[query]:
            for target in range(starts[word], starts[word + 1]):
                total = np.uint32(0)  # of 32 bits all the way: half the time of 64
                for k in range(queries.shape[1]):
                    product = np.uint16(queries[query, k]) * np.uint16(targets[target, k])
                    total = np.uint32(total + np.uint32(product))
                dot = np.int64(total)
                if dot > largest:
                    place, largest, next_largest = target, dot, largest
                elif dot > next_largest:
                    next_largest = dot
        best[query], dots[query, 0], dots[query, 1] = place, largest, next_largest
