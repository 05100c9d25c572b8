"""Which pairs of photographs to match: positions (first, second) with first < second."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stages.structure.gates import connected_groups

Pair = tuple[int, int]

NEIGHBOURS = 20  # in order of the capture, for sequential matching; and 32, 64, ... apart
BEST = 14  # pairs that a photograph asks for
FEWEST_SEEN_ALIKE = 4  # matches of a first look; pairs of other places have up to that many
LINK_INLIERS = 30
FEWEST_LINKS = 3
MOST_TO_CLOSE_GAPS = 20  # pairs, for each photograph of the capture


def exhaustive_pairs(photographs: int) -> list[Pair]:
    """All pairs."""
    return list(itertools.combinations(range(photographs), 2))


def sequential_pairs(photographs: int) -> list[Pair]:
    """Neighbours in order of the capture, and some that are farther apart."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**k for k in range(5, photographs.bit_length()))]
    return sorted((i, i + step) for step in steps for i in range(photographs - step))


def initial_pairs(alike: NDArray[np.int32]) -> list[Pair]:
    """The pairs to begin with: the best few of each photograph, and the next in order.

    alike [P, P] symmetric: matches that a first look found.
    """
    photographs = len(alike)
    pairs = {(i, i + 1) for i in range(photographs - 1)}
    for i, row in enumerate(alike):
        best = np.lexsort((np.abs(np.arange(photographs) - i), -row))[:BEST]
        pairs |= {_pair(i, int(j)) for j in best if j != i and row[j] >= FEWEST_SEEN_ALIKE}
    return sorted(pairs)


def linking_pairs(
    alike: NDArray[np.int32], matched: Iterable[Pair], inliers: dict[Pair, int]
) -> list[Pair]:
    """Pairs to match besides: all others of photographs with few links, and all between groups
    that nothing links; where these are too many, those that look most alike.

    inliers: of the `matched` pairs that were verified.
    """
    photographs = len(alike)
    links = [pair for pair, count in inliers.items() if count >= LINK_INLIERS]
    degree = np.bincount(np.array(links, np.int64).reshape(-1), minlength=photographs)
    group = np.zeros(photographs, np.int64)
    for number, members in enumerate(
        connected_groups([(*pair, 0, 0) for pair in links], photographs)
    ):
        group[members] = number
    few = degree < FEWEST_LINKS
    apart = few[:, None] | few[None, :] | (group[:, None] != group[None, :])
    apart[tuple(np.array(list(matched), np.int64).reshape(-1, 2).T)] = False
    first, second = np.nonzero(np.triu(apart, 1))
    order = np.lexsort((second, first, -alike[first, second]))
    order = order[: MOST_TO_CLOSE_GAPS * photographs]
    return sorted(zip(first[order].tolist(), second[order].tolist(), strict=True))


def _pair(i: int, j: int) -> Pair:
    return (min(i, j), max(i, j))
