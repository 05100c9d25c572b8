"""Which pairs are matched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.sfm.worker import pairs


def around(photographs: int, reach: int = 6) -> NDArray[np.int32]:
    """Looking alike on a closed walk: the nearer, the more."""
    apart = np.abs(np.subtract.outer(np.arange(photographs), np.arange(photographs)))
    apart = np.minimum(apart, photographs - apart)
    return np.where(apart > reach, 1, 100 - 10 * apart).astype(np.int32) * (apart > 0)


def test_exhaustive_pairs_hold_every_pair_once() -> None:
    assert pairs.exhaustive_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_a_loop_is_matched_along_it_and_where_it_closes() -> None:
    found = pairs.initial_pairs(around(300))
    assert (0, 299) in found
    assert (0, 6) in found
    assert (0, 150) not in found
    assert len(found) <= 300 * pairs.BEST


def test_pairs_grow_with_photographs_and_not_with_their_square() -> None:
    alike = np.full((400, 400), 50, np.int32)
    assert len(pairs.initial_pairs(alike)) <= 400 * (pairs.BEST + 1)
    nothing_linked = pairs.linking_pairs(alike, [], {})
    assert len(nothing_linked) <= 400 * pairs.MOST_LINKING_PAIRS


def test_neighbours_are_matched_even_if_nothing_is_similar() -> None:
    assert pairs.initial_pairs(np.zeros((4, 4), np.int32)) == [(0, 1), (1, 2), (2, 3)]


def test_an_unlinked_photograph_is_matched_with_all_and_nothing_twice() -> None:
    alike = around(12)
    matched = pairs.initial_pairs(alike)
    inliers = {pair: 0 if 5 in pair else 200 for pair in matched}
    more = pairs.linking_pairs(alike, matched, inliers)
    assert more == [p for p in pairs.exhaustive_pairs(12) if 5 in p and p not in matched]


def test_unconnected_components_are_matched_with_each_other() -> None:
    alike = np.zeros((12, 12), np.int32)
    matched = [(i, j) for i, j in pairs.exhaustive_pairs(12) if (i < 5) == (j < 5)]
    more = pairs.linking_pairs(alike, matched, dict.fromkeys(matched, 90))
    assert more == [(i, j) for i, j in pairs.exhaustive_pairs(12) if (i < 5) != (j < 5)]


def test_of_too_many_pairs_the_most_similar_are_matched() -> None:
    alike = np.zeros((100, 100), np.int32)
    alike[3, 70] = alike[70, 3] = 9
    more = pairs.linking_pairs(alike, [], {})
    assert (3, 70) in more
    assert len(more) == 100 * pairs.MOST_LINKING_PAIRS


def test_a_connected_view_graph_needs_no_more_pairs() -> None:
    matched = pairs.initial_pairs(around(40))
    assert pairs.linking_pairs(around(40), matched, dict.fromkeys(matched, 100)) == []
