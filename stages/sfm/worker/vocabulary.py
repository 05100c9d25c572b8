"""A vocabulary of visual words, and the features of a photograph as an inverted file.

Two similar descriptors mostly have the same nearest word, or share one of their nearest words. So
the nearest neighbour of a descriptor among thousands is searched under a few words only (inverted
file with several probes: Jegou et al. 2011). The vocabulary is built from the capture's own
descriptors, so that none has to be trained or shipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VOCABULARY_SIZE = 256
PROBED_WORDS = 8  # for each feature; finds 97 of 100 matches of an exhaustive search
# Least number of features that each is compared with. Among few features, the second nearest, which
# the ratio test needs, is often under another word.
FEWEST_COMPARED = 256
SAMPLED_DESCRIPTORS = 32768  # that the vocabulary is built from
_ITERATIONS = 8


@dataclass(frozen=True)
class FeatureIndex:
    """N features of one photograph, sorted by visual word.

    Args:
        rows: [N] index of each feature in the photograph's list.
        descriptors: [N, 128] uint8.
        probes: [N, K] words under which the match of each feature is searched.
        starts: [W + 1] the features of word w are starts[w] to starts[w + 1].
    """

    rows: NDArray[np.int32]
    descriptors: NDArray[np.uint8]
    probes: NDArray[np.int32]
    starts: NDArray[np.signedinteger]


def build_vocabulary(sample: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[W, 128] cluster centres of `sample` [S, 128] by k-means (Lloyd 1982); at most S of them."""
    if not len(sample):
        return np.zeros((1, sample.shape[1]), np.float32)
    points = sample.astype(np.float32)
    random = np.random.default_rng(0)
    words = points[random.permutation(len(points))[:VOCABULARY_SIZE]]
    for _ in range(_ITERATIONS):
        nearest = _similarity(points, words).argmax(axis=1)
        counts = np.bincount(nearest, minlength=len(words))
        used = np.flatnonzero(counts)
        starts = np.cumsum(counts[used]) - counts[used]
        sums = np.add.reduceat(points[np.argsort(nearest, kind="stable")], starts, axis=0)
        words[used] = sums / counts[used, None]
    return words


def index_by_word(
    descriptors: NDArray[np.uint8], vocabulary: NDArray[np.float32], compared: int = FEWEST_COMPARED
) -> FeatureIndex:
    """The features with these descriptors [N, 128], sorted by their nearest words.

    compared: the number of probes is such that each feature is compared with about this many.
    """
    similarity = _similarity(descriptors.astype(np.float32), vocabulary)
    nearest = similarity.argmax(axis=1)
    order = np.argsort(nearest, kind="stable")
    wanted = max(PROBED_WORDS, math.ceil(compared * len(vocabulary) / max(1, len(order))))
    count = min(wanted, len(vocabulary))
    best = np.argpartition(-similarity, count - 1, axis=1)[:, :count]
    # In order of words, consecutive features read the same descriptors, which are in the cache.
    probes = np.sort(best, axis=1).astype(np.int32)
    counts = np.bincount(nearest, minlength=len(vocabulary))
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return FeatureIndex(order.astype(np.int32), descriptors[order], probes[order], starts)


def word_pairs(
    descriptors: NDArray[np.uint8], vocabulary: NDArray[np.float32]
) -> NDArray[np.int64]:
    """[N] the two nearest words of each descriptor [N, 128] as one number. W words give
    W (W - 1) / 2 pairs, a vocabulary fine enough for image retrieval."""
    if len(vocabulary) < 2:
        return np.zeros(len(descriptors), np.int64)
    similarity = _similarity(descriptors.astype(np.float32), vocabulary)
    two = np.sort(np.argpartition(-similarity, 1, axis=1)[:, :2], axis=1)
    return two[:, 0] * len(vocabulary) + two[:, 1]


def _similarity(points: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, W] larger for smaller Euclidean distances."""
    return np.asarray(points @ words.T - 0.5 * np.sum(words**2, axis=1))
