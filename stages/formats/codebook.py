"""Vector quantisation by k-means: a codebook of scalars and a palette of vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.row_slices import row_slices

SIZE = 256
_SCALAR_ROUNDS, _VECTOR_ROUNDS = 30, 6
_COARSE = 128
_SAMPLE = 1 << 15  # vectors for the coarse clusters
_ROWS_AT_ONCE = 1 << 14
_DISTINCT_SAMPLE = 2  # times the palette size: if so many vectors all differ, it is too small


def scalar_codebook(values: NDArray[np.floating], size: int = SIZE) -> NDArray[np.float64]:
    """[size] ascending codebook of the values [M] with small squared error (Lloyd's algorithm);
    exact if there are at most `size` distinct values."""
    ordered = np.sort(values, axis=None)
    new = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    if np.count_nonzero(new) <= size:
        distinct = ordered[new].astype(np.float64)
        padding = np.full(size - len(distinct), distinct[-1] if len(distinct) else 0.0)
        return np.concatenate([distinct, padding])
    # Half of the initial centres at quantiles, half evenly spaced for the outliers.
    ranks = np.linspace(0, len(ordered) - 1, size // 2).astype(np.intp)
    even = np.linspace(ordered[0], ordered[-1], size - size // 2)
    centres = np.sort(np.concatenate([ordered[ranks], even]))
    sums, squares = _prefix_sums(ordered, 1), _prefix_sums(ordered, 2)
    for _ in range(_SCALAR_ROUNDS):
        # in the type of the values, which NumPy would otherwise copy
        middles = ((centres[1:] + centres[:-1]) / 2).astype(ordered.dtype)
        ends = np.searchsorted(ordered, middles)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        used = np.flatnonzero(counts)
        means = np.diff(sums[ends])[used] / counts[used]
        errors = np.maximum(np.diff(squares[ends])[used] - counts[used] * means * means, 0)
        # A centre without values splits the cell with the largest error.
        widest = np.argsort(-errors, kind="stable")[: size - len(used)]
        spread = np.sqrt(errors[widest] / counts[used][widest])
        extra = np.resize(means[widest] + spread, size - len(used))
        centres = np.sort(np.concatenate([means, extra]))
    return centres


def _prefix_sums(ordered: NDArray[np.floating], power: int) -> NDArray[np.float64]:
    """[M + 1] prefix sums of the values to the power 1 or 2."""
    sums = scratch.empty((len(ordered) + 1,), np.float64)
    sums[0] = 0
    for rows in row_slices(len(ordered)):
        part = sums[rows.start : rows.stop + 1]  # begins with the sum so far
        np.power(ordered[rows], power, out=part[1:], dtype=np.float64)
        np.cumsum(part, out=part)
    return sums


def nearest(codebook: NDArray[np.float64], values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """The index of the nearest codebook entry, in the shape of `values`."""
    middles = (codebook[1:] + codebook[:-1]) / 2
    indices = np.empty(values.shape, np.uint8)
    for rows in row_slices(len(values)):
        indices[rows] = np.searchsorted(middles, values[rows].astype(np.float64))
    return indices


def vector_palette(
    vectors: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """(palette [at most `size`, D], label of each of the `vectors` [N, D]).

    Hierarchical k-means, so that time grows with the square root of the palette: coarse clusters
    first, then entries within each in proportion to its vectors. Zero vectors stay zero. Exact if
    at most `size` vectors are distinct.
    """
    if len(_distinct(vectors[: _DISTINCT_SAMPLE * size])[0]) <= size:  # a sample decides quickly
        first, which = _distinct(vectors)
        if len(first) <= size:
            order = np.lexsort(vectors[first].T)
            return vectors[first[order]], np.argsort(order)[which]
    labels = np.zeros(len(vectors), np.intp)
    palette = [np.zeros((1, vectors.shape[1]), np.float32)]
    some = [
        np.flatnonzero(vectors[part].any(axis=1)) + part.start for part in row_slices(len(vectors))
    ]
    rows = np.concatenate([np.zeros(0, np.intp), *some])
    rng = np.random.default_rng(0)
    sample = np.sort(rng.permutation(rows)[:_SAMPLE])
    coarse = _centres(vectors[sample], min(_COARSE, max(1, size // 8)), rng)
    cluster = np.empty(len(rows), np.int32)
    for part in row_slices(len(rows)):
        cluster[part] = _assigned(vectors[rows[part]], coarse)
    # rows grouped by cluster, otherwise in their order
    rows = rows[np.argsort(cluster, kind="stable")]
    ends = np.cumsum(np.bincount(cluster, minlength=len(coarse)))
    used = 1
    for k in row_slices(len(coarse), 1):
        members = rows[ends[k.start - 1] if k.start else 0 : ends[k.start]]
        if not len(members):
            continue
        share = max(1, (size - 1 - len(coarse)) * len(members) // len(rows))
        inside = vectors[members]
        fine = _centres(inside, share, rng)
        labels[members] = used + _assigned(inside, fine)
        palette.append(fine)
        used += len(fine)
    return np.concatenate(palette), labels


def _distinct(vectors: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(the first row of each distinct vector, the number of its distinct vector for each row), by a
    64-bit hash."""
    factors = np.random.default_rng(1).integers(1, 1 << 63, vectors.shape[1], np.uint64) | 1
    sums = np.empty(len(vectors), np.uint64)
    for rows in row_slices(len(vectors)):
        bits = np.ascontiguousarray(vectors[rows] + np.float32(0)).view(np.uint32)  # -0 is 0
        sums[rows] = (bits * factors).sum(axis=1)
    _, first, which = np.unique(sums, return_index=True, return_inverse=True)
    return first, which.ravel()


def _centres(
    vectors: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """[at most count, D] cluster centres by Lloyd's algorithm from random vectors."""
    if len(vectors) <= count:
        return vectors
    centres = vectors[np.sort(rng.choice(len(vectors), count, replace=False))]
    for _ in range(_VECTOR_ROUNDS):
        labels = _assigned(vectors, centres)
        order = np.argsort(labels, kind="stable")
        counts = np.bincount(labels, minlength=len(centres))
        there = np.flatnonzero(counts)
        starts = (np.cumsum(counts) - counts)[there]
        sums = np.add.reduceat(vectors[order], starts, axis=0)
        centres = centres.copy()
        centres[there] = sums / counts[there, None].astype(np.float32)
    return centres


def _assigned(vectors: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.intp]:
    """[N] the nearest centre of each vector."""
    labels = np.zeros(len(vectors), np.intp)
    lengths = np.square(centres).sum(axis=1)
    step = max(64, _ROWS_AT_ONCE * _COARSE // max(1, len(centres)))
    for start in range(0, len(vectors), step):
        block = vectors[start : start + step]
        labels[start : start + step] = (lengths - 2 * block @ centres.T).argmin(axis=1)
    return labels
