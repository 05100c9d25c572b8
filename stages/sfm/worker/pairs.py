"""Which pairs of photographs to match: positions (first, second) with first < second."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stages.sfm.checks.gates import connected_groups

Pair = tuple[int, int]

BEST = 14  # pairs for each photograph
FEWEST_SIMILAR = 4  # matches of the largest features; unrelated pairs have fewer
LINK_INLIERS = 30
FEWEST_LINKS = 3
MOST_LINKING_PAIRS = 20  # for each photograph of the capture
# Pairs for learned features: each photograph that is to be joined with those that look most like
# it, and each photograph of these pairs with those that it has most inliers with. Mapping registers
# a photograph by the points of such neighbours.
JOINING = 10
SUPPORTING = 4


def exhaustive_pairs(photographs: int) -> list[Pair]:
    """All pairs."""
    return list(itertools.combinations(range(photographs), 2))


def pairs_of_faces(frame_pairs: Iterable[Pair], frames: NDArray[np.int64]) -> list[Pair]:
    """All pairs of photographs of these pairs of frames. frames [P]: number of each photograph's
    frame: the faces of a panorama share one."""
    members = [np.flatnonzero(frames == frame).tolist() for frame in range(int(frames.max()) + 1)]
    both = (itertools.product(members[a], members[b]) for a, b in frame_pairs)
    return sorted((min(pair), max(pair)) for product in both for pair in product)


def initial_pairs(similarity: NDArray[np.int32]) -> list[Pair]:
    """The pairs to match first: the most similar of each photograph, and the next in order.

    similarity [P, P] symmetric: matches among the largest features.
    """
    photographs = len(similarity)
    pairs = {(i, i + 1) for i in range(photographs - 1)}
    for i, row in enumerate(similarity):
        best = np.lexsort((np.abs(np.arange(photographs) - i), -row))[:BEST]
        pairs |= {_pair(i, int(j)) for j in best if j != i and row[j] >= FEWEST_SIMILAR}
    return sorted(pairs)


def linking_pairs(
    similarity: NDArray[np.int32],
    matched: Iterable[Pair],
    inliers: dict[Pair, int],
    frames: NDArray[np.int64] | None = None,
) -> list[Pair]:
    """More pairs to match so that links connect all photographs: every pair with a photograph that
    has few links, and every pair between two unconnected groups; if these are too many, the most
    similar ones.

    Args:
        similarity: [P, P] as in `initial_pairs`.
        matched: pairs that were matched.
        inliers: of those that were verified; enough of them make a link.
        frames: [P] as in `pairs_of_faces`; None: there are no panoramas. The faces of a panorama
            are linked together.
    """
    photographs = len(similarity)
    frames = np.arange(photographs) if frames is None else frames
    most = int(frames.max()) + 1
    linked = (pair for pair, count in inliers.items() if count >= LINK_INLIERS)
    links = frames[np.array(list(linked), np.int64).reshape(-1, 2)]
    degree = np.bincount(links.reshape(-1), minlength=most)[frames]
    group = np.zeros(most, np.int64)
    for number, members in enumerate(connected_groups(links.tolist(), most)):
        group[members] = number
    group = group[frames]
    few = degree < FEWEST_LINKS
    wanted = few[:, None] | few[None, :] | (group[:, None] != group[None, :])
    wanted &= frames[:, None] != frames[None, :]
    wanted[tuple(np.array(list(matched), np.int64).reshape(-1, 2).T)] = False
    first, second = np.nonzero(np.triu(wanted, 1))
    order = np.lexsort((second, first, -similarity[first, second]))
    order = order[: MOST_LINKING_PAIRS * photographs]
    return sorted(zip(first[order].tolist(), second[order].tolist(), strict=True))


def joining_pairs(
    likeness: NDArray[np.int32], inliers: dict[Pair, int], wanted: Iterable[int]
) -> list[Pair]:
    """The pairs to match by learned features so that photographs are joined to the others.

    Args:
        likeness: [P, P] symmetric: how alike two photographs look.
        inliers: of the pairs that SIFT matched; enough of them make a link.
        wanted: positions of the photographs to join.
    """
    photographs = len(likeness)
    linked = np.zeros((photographs, photographs), np.int64)
    for (i, j), count in inliers.items():
        if count >= LINK_INLIERS:
            linked[i, j] = linked[j, i] = count
    pairs = set()
    for i in wanted:
        row = np.where(linked[i] > 0, -1, likeness[i])
        row[i] = -1
        best = np.lexsort((np.abs(np.arange(photographs) - i), -row))[:JOINING]
        pairs |= {_pair(i, int(j)) for j in best if row[j] > 0}
    for i in {position for pair in pairs for position in pair}:
        best = np.argsort(-linked[i], kind="stable")[:SUPPORTING]
        pairs |= {_pair(i, int(j)) for j in best if linked[i, j]}
    return sorted(pairs)


def without_weaker(inliers: dict[Pair, int], uncertain: Iterable[Pair]) -> set[Pair]:
    """The `uncertain` pairs to drop: a chain of other pairs, each with more inliers, links the same
    photographs. Learned features also match what only looks alike, such as both sides of an object.
    Where they are wrong, a chain of pairs around the object mostly has more matches.

    inliers: of all pairs with a two-view geometry.
    """
    photographs = 1 + max((pair[1] for pair in inliers), default=0)
    group = np.arange(photographs)  # of those that stronger pairs link
    uncertain, dropped = set(uncertain), set()
    for pair in sorted(inliers, key=lambda pair: (-inliers[pair], pair)):
        first, second = group[list(pair)]
        if first == second and pair in uncertain:
            dropped.add(pair)
        group[group == second] = first
    return dropped


def _pair(i: int, j: int) -> Pair:
    return (min(i, j), max(i, j))
