"""Image retrieval: which pairs are proposed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.sfm.worker import retrieval
from stages.sfm.worker.pairs import exhaustive_pairs
from stages.sfm.worker.vocabulary import word_pairs


def walk_past(places: NDArray[np.integer], each: int = 60) -> list[NDArray[np.int64]]:
    """Words of photographs: of the five places around each one's own, and of nowhere."""
    random = np.random.default_rng(0)
    local = random.integers(0, 32_000, (int(places.max()) + 5, each))
    return [
        np.concatenate([local[place : place + 5].ravel(), random.integers(0, 32_000, 500)])
        for place in places
    ]


def test_of_few_photographs_every_pair_is_proposed() -> None:
    assert retrieval.candidate_pairs(walk_past(np.arange(30))) == exhaustive_pairs(30)


def test_a_loop_closure_is_found_among_many_photographs() -> None:
    there_and_back = np.concatenate([np.arange(200), np.arange(200)[::-1]])
    found = set(retrieval.candidate_pairs(walk_past(there_and_back)))
    assert all((i, 399 - i) in found for i in range(200))
    assert all((i, i + 4) in found for i in range(396))


def test_pairs_grow_with_photographs_and_not_with_their_square() -> None:
    most = retrieval.CANDIDATES + retrieval.NEIGHBOURS
    assert len(retrieval.candidate_pairs(walk_past(np.arange(400)))) <= 400 * most


def test_words_in_every_photograph_have_no_weight_and_no_words_do_no_harm() -> None:
    common, none = np.zeros(100, np.int64), np.empty(0, np.int64)
    words_of = [common] * 60 + [none] * 40
    words_of[3] = words_of[90] = np.array([7, 8, 9])
    found = retrieval.candidate_pairs(words_of)
    assert (3, 90) in found
    assert {i for pair in found for i in pair} == set(range(100))


def test_a_word_pair_is_the_two_nearest_words() -> None:
    vocabulary = np.eye(4, 128, dtype=np.float32) * 200
    near = np.zeros((2, 128), np.uint8)
    near[0, [1, 3]] = 180, 120
    near[1, [3, 1]] = 180, 120
    assert word_pairs(near, vocabulary).tolist() == [7, 7]
    assert word_pairs(near, vocabulary[:1]).tolist() == [0, 0]
