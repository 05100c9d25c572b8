"""Matches found under a few probed words are nearly those of an exhaustive search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.sfm.worker import descriptor_matching, features
from stages.sfm.worker.vocabulary import build_vocabulary, index_by_word
from tests.sfm.worker.sample_jobs import SAMPLE


def exhaustive_matches(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> set[tuple[int, int]]:
    """Mutual nearest neighbours by angle that pass the ratio test in both directions."""
    cosines = first.astype(float) @ second.astype(float).T / 512.0**2
    angles = np.arccos(np.minimum(cosines, 1.0))

    def clear(table: NDArray[np.float64]) -> NDArray[np.int64]:
        best, next_best = np.sort(table, axis=1)[:, :2].T
        good = (best <= descriptor_matching.LARGEST_ANGLE) & (
            best < descriptor_matching.RATIO * next_best
        )
        return np.where(good, table.argmin(axis=1), -1)

    there, back = clear(angles), clear(angles.T)
    return {(i, int(j)) for i, j in enumerate(there) if j >= 0 and back[j] == i}


def test_nearly_all_matches_are_found_and_hardly_others() -> None:
    photographs = sorted(SAMPLE.glob("*.jpg"))
    first, second = (features.sift_features(photographs[i], 3000, 0.0045)[1] for i in (0, 2))
    vocabulary = build_vocabulary(np.concatenate([first, second])[::2])
    found = descriptor_matching.match_descriptors(
        index_by_word(first, vocabulary), index_by_word(second, vocabulary)
    )
    wanted = exhaustive_matches(first, second)
    got = {(int(i), int(j)) for i, j in found}
    assert len(wanted) > 300
    assert len(got & wanted) > 0.93 * len(wanted)
    assert len(got - wanted) < 0.05 * len(wanted)
    assert len(np.unique(found[:, 0])) == len(np.unique(found[:, 1])) == len(found)
    assert (np.diff(found[:, 0].astype(int)) > 0).all()


def test_a_picture_matches_itself() -> None:
    random = np.random.default_rng(0)
    histograms = random.exponential(size=(400, 128)) ** 2
    roots = np.sqrt(histograms / histograms.sum(axis=1, keepdims=True))
    descriptors = np.rint(512 * roots).clip(0, 255).astype(np.uint8)
    own = index_by_word(descriptors, build_vocabulary(descriptors))
    assert (descriptor_matching.match_descriptors(own, own) == np.arange(400)[:, None]).all()


def test_no_features_match_nothing() -> None:
    none = np.empty((0, 128), np.uint8)
    vocabulary = build_vocabulary(none)
    empty = index_by_word(none, vocabulary)
    some = index_by_word(np.full((5, 128), 45, np.uint8), vocabulary)
    assert (
        descriptor_matching.match_descriptors(empty, some).shape
        == descriptor_matching.match_descriptors(some, empty).shape
        == (0, 2)
    )


def test_the_vocabulary_of_few_features_is_small() -> None:
    assert len(build_vocabulary(np.eye(7, 128, dtype=np.uint8) * 200)) == 7
