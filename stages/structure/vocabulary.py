"""A vocabulary of descriptors, and the features of a photograph sorted by its words.

Two descriptors that are near each other mostly have the same nearest word, or words that are near
both: who looks for the nearest of thousands need look only under a few words. The capture's own
descriptors make the vocabulary, so that nothing has to be learned or shipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VOCABULARY_SIZE = 256
PROBED_WORDS = 8  # words for each feature; finds 97 of 100 of the matches that looking at all finds
# Features that each is compared with, at least: of few features, the second nearest, by which the
# nearest is judged, is often under another word.
FEWEST_COMPARED = 256
SAMPLED_DESCRIPTORS = 32768  # descriptors that the vocabulary is made from
_ROUNDS = 8


@dataclass(frozen=True)
class FeatureIndex:
    """N features of one photograph, sorted by word.

    rows [N]: place of each in the photograph's list. descriptors [N, 128] uint8. near [N, K]:
    words to look under for the partner of each. starts [W + 1]: the features of word w are
    starts[w] to starts[w + 1].
    """

    rows: NDArray[np.int32]
    descriptors: NDArray[np.uint8]
    near: NDArray[np.int32]
    starts: NDArray[np.signedinteger]


def build_vocabulary(sample: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[W, 128] means of clusters of `sample` [S, 128] (Lloyd 1982); at most S of them."""
    if not len(sample):
        return np.zeros((1, sample.shape[1]), np.float32)
    points = sample.astype(np.float32)
    random = np.random.default_rng(0)
    words = points[random.permutation(len(points))[:VOCABULARY_SIZE]]
    for _ in range(_ROUNDS):
        nearest = _likeness(points, words).argmax(axis=1)
        counts = np.bincount(nearest, minlength=len(words))
        used = np.flatnonzero(counts)
        starts = np.cumsum(counts[used]) - counts[used]
        sums = np.add.reduceat(points[np.argsort(nearest, kind="stable")], starts, axis=0)
        words[used] = sums / counts[used, None]
    return words


def index_by_word(
    descriptors: NDArray[np.uint8], words: NDArray[np.float32], compared: int = FEWEST_COMPARED
) -> FeatureIndex:
    """The features with these descriptors [N, 128], sorted by their nearest words.

    compared: with about so many features each will be compared, or with more.
    """
    likeness = _likeness(descriptors.astype(np.float32), words)
    nearest = likeness.argmax(axis=1)
    order = np.argsort(nearest, kind="stable")
    wanted = max(PROBED_WORDS, math.ceil(compared * len(words) / max(1, len(order))))
    count = min(wanted, len(words))
    under = np.argpartition(-likeness, count - 1, axis=1)[:, :count]
    # In order of words, neighbours in the list look at the same descriptors, which are at hand.
    near = np.sort(under, axis=1).astype(np.int32)
    counts = np.bincount(nearest, minlength=len(words))
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return FeatureIndex(order.astype(np.int32), descriptors[order], near[order], starts)


def word_pairs(descriptors: NDArray[np.uint8], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """[N] the two nearest words of each descriptor [N, 128] as one number: of W words they make
    W (W - 1) / 2, fine enough to tell places apart."""
    if len(words) < 2:
        return np.zeros(len(descriptors), np.int64)
    likeness = _likeness(descriptors.astype(np.float32), words)
    two = np.sort(np.argpartition(-likeness, 1, axis=1)[:, :2], axis=1)
    return two[:, 0] * len(words) + two[:, 1]


def _likeness(points: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, W] the larger, the nearer."""
    likeness: NDArray[np.float32] = points @ words.T - 0.5 * np.sum(words**2, axis=1)
    return likeness
