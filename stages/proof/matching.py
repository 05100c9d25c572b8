"""Matching the rows of a file to the rows of the original: files may reorder splats."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.base import scratch
from stages.base.row_slices import row_slices
from stages.scene import Splats, dc_to_rgb
from stages.scene.quantiles import quantiles

Rows = NDArray[np.intp]

# Two rows match if their distance is less than this share of the scene's extent, and have like
# values if at most one of those below differs more. These are several times the errors of the
# packed formats.
_APART = 0.005
_OPACITY, _COLOUR, _LOG_SCALE = 1 / 64, 0.05, 0.25
_EXACT = 1e-6  # of the extent: positions that only rounding moved
_MAX_MISMATCHED = 0.05  # share of the rows; an order with more rows of unlike values is rejected
# Weight of distances against the other values when neighbours are compared.
_DISTANCE_WEIGHT = 20.0
_NEIGHBOURS = 8
_ROUNDS = 8


@dataclass(frozen=True)
class _Side:
    """means: [N, 3]. values: [N, 7], see `_values`."""

    means: NDArray[np.floating]
    values: NDArray[np.float32]


def extent_of(splats: Splats) -> float:
    """The diagonal of the box of the central 90 % of the centres; the size of the largest splat
    where this is 0. Never 0."""
    if len(splats) == 0:
        return 1.0
    low, high = quantiles(splats.means, (0.05, 0.95))
    largest = float(np.exp(min(float(splats.log_scales.max()), 80.0)))
    return float(np.linalg.norm(high - low)) or max(largest, 1e-12)


def matched_rows(truth: Splats, file: Splats, orders: Iterable[Rows]) -> Rows:
    """[N] for each row of `file`, its row in `truth`; a permutation.

    The first order that matches nearly all rows is taken; else the order in which the most rows
    match, if nearly all have like values: a format that moved many positions has kept the order.
    Its mismatched rows are then matched among themselves, each to the most similar of its nearest
    neighbours, or of like values although it moved.

    Args:
        truth, file: N splats each, in the same axes.
        orders: orders in which the file may have been written; the unchanged order is tried first.
    """
    n, extent = len(truth), extent_of(truth)
    here, there = (_Side(splats.means, _values(splats)) for splats in (truth, file))
    every = np.arange(n)
    found, fewest = (every, every, np.zeros(n, bool)), n + 1
    for index in (np.arange(n), *orders) if n else ():
        distance, unlike = np.empty(n, np.float32), np.empty(n, bool)
        for rows in row_slices(n):
            moved = np.abs(truth.means[index[rows]] - file.means[rows])
            distance[rows] = moved.max(axis=1, initial=0.0)
            unlike[rows] = _unlike(here.values[index[rows]], there.values[rows])
        far = distance > _APART * extent
        mismatched, most = far | unlike, _MAX_MISMATCHED * n
        count = int(np.count_nonzero(mismatched))
        like = np.count_nonzero(unlike) <= most and np.count_nonzero(far) <= n - most
        if like and count < fewest:
            if np.median(distance) <= _EXACT * extent:  # then neighbours can be distinguished
                mismatched |= distance > _EXACT * extent
            found, fewest = (index, np.flatnonzero(mismatched), far[mismatched]), count
        if fewest <= most:
            break
    _match_neighbours(here, there, *found, _APART * extent / _DISTANCE_WEIGHT)
    return found[0]


def _values(splats: Splats) -> NDArray[np.float32]:
    """[N, 7] opacity, colour and log scales, each divided by its allowed difference."""
    values = scratch.empty((len(splats), 7))
    for rows in row_slices(len(splats)):
        block = splats.take(rows)
        values[rows, 0] = block.opacities / _OPACITY
        values[rows, 1:4] = np.minimum(dc_to_rgb(block.sh[:, 0]), 1) / _COLOUR
        values[rows, 4:] = block.log_scales / _LOG_SCALE
    return values


def _unlike(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[N] whether more than one of opacity, colour and scales differ too much."""
    far = np.abs(a - b) > 1
    return np.asarray(far[:, 0].astype(int) + far[:, 1:4].any(axis=1) + far[:, 4:].any(axis=1) > 1)


def _match_neighbours(
    truth: _Side, file: _Side, index: Rows, mismatched: Rows, moved: NDArray[np.bool_], unit: float
) -> None:
    """Match the rows `mismatched` among themselves, changing `index` in place.

    In each round every remaining row proposes to the most similar of its nearest neighbours; of
    several proposals for one row the most similar wins. In the first round a row that has `moved`
    may also propose to its own, at the cost of one allowed difference instead of its distance.
    """
    mine, theirs = mismatched, index[mismatched]
    for _ in range(_ROUNDS):
        # in a tree of coinciding points, every search would visit all of them
        if len(mine) < 2 or len(np.unique(truth.means[theirs, 0])) * 100 < len(theirs):
            break
        count = min(_NEIGHBOURS, len(theirs))
        tree = cKDTree(truth.means[theirs].astype(np.float64))
        distances, places = tree.query(file.means[mine].astype(np.float64), count)
        choice = np.arange(len(mine))
        unlike = np.square(truth.values[theirs] - file.values[mine]).sum(axis=1)
        cost = np.where(moved, unlike + 1, np.inf)
        for place, distance in zip(places.T, distances.T, strict=True):
            unlike = np.square(truth.values[theirs[place]] - file.values[mine]).sum(axis=1)
            total = np.square(distance / unit) + unlike
            better = total < cost
            cost[better], choice[better] = total[better], place[better]
        by_cost = np.argsort(cost, kind="stable")
        taken, first = np.unique(choice[by_cost], return_index=True)
        matched = by_cost[first]
        index[mine[matched]] = theirs[taken]
        mine, theirs = np.delete(mine, matched), np.delete(theirs, taken)
        moved = np.zeros(len(mine), bool)
        if len(matched) * 10 < len(mine):
            break
    index[mine] = theirs
