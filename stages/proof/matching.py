"""Which row of the original each row of a file is: files may hold the same splats in any order."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.blocks import blocks, reported_blocks
from stages.scene import Splats, dc_to_rgb
from stages.scene.quantiles import quantiles

Rows = NDArray[np.intp]

# Two rows may be the same splat if their positions are nearer than this part of the scene's extent
# and of the values below at most one differs more: several times what the packed formats change.
_APART = 0.005
_OPACITY, _COLOUR, _LOG_SCALE = 1 / 64, 0.05, 0.25
_EXACT = 1e-6  # of the extent: positions that only rounding moved
_MAY_BE_ODD = 0.05  # of the rows; an order that leaves more unexplained is another order
# For choosing among neighbours, distance counts as if it were this much more precise.
_SHARPER = 20.0
_NEIGHBOURS = 8
_ROUNDS = 8
_KDTREE_SINGLE = 4  # OpenCV's name for the exact tree for few dimensions


def extent_of(splats: Splats) -> float:
    """Length of the diagonal around the middle nine tenths of the centres; of the largest splat
    where there is no such length. Never 0."""
    if len(splats) == 0:
        return 1.0
    low, high = quantiles(splats.means, (0.05, 0.95))
    largest = float(np.exp(min(float(splats.log_scales.max()), 80.0)))
    return float(np.linalg.norm(high - low)) or max(largest, 1e-12)


def matched_rows(truth: Splats, file: Splats, orders: Iterable[Rows]) -> Rows:
    """[N]: for each row of `file` the row of `truth` that it is; every row occurs once.

    Both must have N rows and lie in the same axes. orders: ways in which the rows may have been
    sorted; the first that explains nearly all of them is taken, no sorting at all being tried
    before. The rows that it leaves unexplained, or all, are paired anew among themselves: with the
    most alike of the nearest.
    """
    n, extent = len(truth), extent_of(truth)
    if n == 0:
        return np.zeros(0, np.intp)
    values = _values(truth), _values(file)
    unit = _APART * extent / _SHARPER
    for index in (np.arange(n), *orders):
        apart, odd = np.empty(n, np.float32), np.empty(n, bool)
        for rows in reported_blocks(n):
            moved = np.abs(truth.means[index[rows]] - file.means[rows])
            apart[rows] = moved.max(axis=1, initial=0.0)
            unlike = _unlike(values[0][index[rows]], values[1][rows])
            odd[rows] = (apart[rows] > _APART * extent) | unlike
        if np.count_nonzero(odd) <= _MAY_BE_ODD * n:
            if np.median(apart) <= _EXACT * extent:  # then neighbours can be told apart
                odd |= apart > _EXACT * extent
            _pair_anew(truth, file, index, np.flatnonzero(odd), unit, *values)
            return index
    index = np.arange(n)
    _pair_anew(truth, file, index, index.copy(), unit, *values)
    return index


def _values(splats: Splats) -> NDArray[np.float32]:
    """[N, 7] opacity, colour and sizes, each as a multiple of what may differ."""
    values = scratch.empty((len(splats), 7))
    for rows in blocks(len(splats)):
        block = splats.take(rows)
        values[rows, 0] = block.opacities / _OPACITY
        values[rows, 1:4] = np.minimum(dc_to_rgb(block.sh[:, 0]), 1) / _COLOUR
        values[rows, 4:] = block.log_scales / _LOG_SCALE
    return values


def _unlike(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[N] where more than one of opacity, colour and sizes differ too much."""
    far = np.abs(a - b) > 1
    found: NDArray[np.bool_] = (
        far[:, 0].astype(int) + far[:, 1:4].any(axis=1) + far[:, 4:].any(axis=1) > 1
    )
    return found


def _pair_anew(
    truth: Splats,
    file: Splats,
    index: Rows,
    odd: Rows,
    unit: float,
    truths: NDArray[np.float32],
    files: NDArray[np.float32],
) -> None:
    """Change `index` at the rows `odd`, in rounds: each row left asks for the most alike of its
    nearest, and of those that ask for the same one the most alike gets it."""
    import cv2

    mine, theirs = odd, index[odd]
    for _ in range(_ROUNDS):
        # a tree of points that all coincide would be searched from end to end for each
        if len(mine) < 2 or len(np.unique(truth.means[theirs, 0])) * 100 < len(theirs):
            break
        count = min(_NEIGHBOURS, len(theirs))
        tree = cv2.flann.Index(
            np.ascontiguousarray(truth.means[theirs], np.float32),
            {"algorithm": _KDTREE_SINGLE, "leaf_max_size": 10},
        )
        asked = np.ascontiguousarray(file.means[mine], np.float32)
        places, squares = tree.knnSearch(asked, count, params={"checks": -1})
        cost = np.full(len(mine), np.inf)
        choice = np.zeros(len(mine), np.intp)
        for place, square in zip(places.T, squares.T, strict=True):
            unlike = np.square(truths[theirs[place]] - files[mine]).sum(axis=1)
            total = square.astype(np.float64) / unit**2 + unlike
            better = total < cost
            cost[better], choice[better] = total[better], place[better]
        by_cost = np.argsort(cost, kind="stable")
        taken, first = np.unique(choice[by_cost], return_index=True)
        served = by_cost[first]
        index[mine[served]] = theirs[taken]
        mine, theirs = np.delete(mine, served), np.delete(theirs, taken)
        if len(served) * 10 < len(mine):
            break
    index[mine] = theirs
