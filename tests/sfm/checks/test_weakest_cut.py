"""What holds a model together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.sfm.checks.statistics import weakest_cut

Seen = tuple[NDArray[np.int64], NDArray[np.int64]]


def seen(tracks: list[tuple[int, ...]]) -> Seen:
    """Observations of points, each by the photographs of its track."""
    points = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    return points, np.array([view for track in tracks for view in track])


def walk(first: int, last: int, each: int = 50) -> list[tuple[int, ...]]:
    return [(i, i + 1, i + 2) for i in range(first, last - 1) for _ in range(each)]


def test_two_halves_are_separated_and_their_common_points_counted() -> None:
    tracks = [*walk(0, 7), *walk(8, 19), *[(6, 7, 8, 9)] * 5, (2, 15)]
    assert weakest_cut(*seen(tracks), 20) == (6, (0, 1, 2, 3, 4, 5, 6, 7))


def test_halves_need_not_be_neighbours_in_order() -> None:
    order = np.random.default_rng(0).permutation(20)
    tracks = [tuple(order[list(track)]) for track in (*walk(0, 7), *walk(8, 19), (7, 8), (6, 9))]
    assert weakest_cut(*seen(tracks), 20) == (2, tuple(sorted(order[:8].tolist())))


def test_halves_without_a_common_point_have_none() -> None:
    assert weakest_cut(*seen([*walk(0, 5), *walk(6, 11)]), 12) == (0, (0, 1, 2, 3, 4, 5))


def test_a_sequence_is_connected_by_points_that_neighbours_share() -> None:
    assert weakest_cut(*seen(walk(0, 19)), 20)[0] == 100


def test_three_photographs_have_no_parts() -> None:
    assert weakest_cut(*seen(walk(0, 3)), 4) == (100, ())
