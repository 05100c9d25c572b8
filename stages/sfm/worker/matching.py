"""Matches of pairs of photographs, verified, in the worker process (imports pycolmap)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.sfm.worker import database as sqlite
from stages.sfm.worker import pairs, retrieval
from stages.sfm.worker.descriptor_matching import match_descriptors
from stages.sfm.worker.job import (
    Matching,
    Project,
    similarity_path,
    vocabulary_path,
)
from stages.sfm.worker.pairs import Pair
from stages.sfm.worker.progress import ProgressWriter
from stages.sfm.worker.vocabulary import (
    SAMPLED_DESCRIPTORS,
    FeatureIndex,
    build_vocabulary,
    index_by_word,
    word_pairs,
)

LARGEST_FEATURES = 1000  # compared for pair selection; they are seen from the farthest
FEWEST_COMPARED_SMALL = 64  # as `vocabulary.FEWEST_COMPARED`, for pair selection: it may err more
FEWEST_INLIERS = 15  # as in COLMAP
MOST_TRIALS = 3000  # of RANSAC, for pairs with few inliers
_CACHED = 256  # photographs whose feature indices stay in memory
# (pair, matches [M, 2], their pixels in both photographs [M, 2]) -> geometry, None if unknown
Pixels = NDArray[np.float64]
KnownGeometry = Callable[
    [Pair, NDArray[np.uint32], Pixels, Pixels], pycolmap.TwoViewGeometry | None
]


def match_all(job: Matching) -> None:
    """Match and verify pairs of photographs, except those that the database holds."""
    with _matcher(job.project) as matcher:
        for wanted in _rounds(job.project, job.how, matcher.features, matcher.inliers):
            matcher.run(wanted)


def match_pairs(project: Project, wanted: Sequence[Pair], known: KnownGeometry) -> None:
    """Match and verify the `wanted` pairs, except those that the database holds. known: gives their
    two-view geometry where it is not to be estimated."""
    with _matcher(project, known) as matcher:
        matcher.run(wanted)


@contextmanager
def _matcher(project: Project, known: KnownGeometry | None = None) -> Iterator[_Matcher]:
    """A matcher. Its reader is closed before its writer, because the last to close a database
    tidies it up."""
    with (
        pycolmap.Database.open(project.database) as database,
        closing(sqlite.StoredFeatures(project.database)) as stored,
    ):
        yield _Matcher(project, database, _IndexedFeatures(project, stored), known)


def _rounds(
    project: Project, how: str, features: _IndexedFeatures, inliers: Mapping[Pair, int]
) -> Iterator[list[Pair]]:
    """Lists of pairs to match, each selected when the one before is matched.

    Args:
        project: with the photographs.
        how: as in `job.Matching`.
        features: of the photographs.
        inliers: of the pairs that are matched.
    """
    frames = project.photographs.frames
    if how == "exhaustive":
        yield pairs.pairs_of_faces(pairs.exhaustive_pairs(int(frames.max()) + 1), frames)
    else:
        similarity = _similarity(project, features)
        first = [(i, j) for i, j in pairs.initial_pairs(similarity) if frames[i] != frames[j]]
        yield first
        known = {pair: inliers[pair] for pair in first}
        yield pairs.linking_pairs(similarity, first, known, frames)


class _IndexedFeatures:
    """Features of photographs by position, indexed by visual word; for several threads."""

    def __init__(self, project: Project, stored: sqlite.StoredFeatures) -> None:
        self._project, self.stored = project, stored
        self.vocabulary = functools.cache(self._vocabulary)
        self.index = functools.lru_cache(_CACHED)(self._index)
        self.points = functools.lru_cache(_CACHED)(stored.points)

    def _vocabulary(self) -> NDArray[np.float32]:
        """Of all photographs; stored beside the database for resumed runs."""
        path, photographs = vocabulary_path(self._project.database), len(self._project.photographs)
        if not path.exists():
            progress = ProgressWriter(self._project.database)
            most = max(1, SAMPLED_DESCRIPTORS // photographs)
            rows = []
            for i in range(photographs):
                descriptors = self.stored.descriptors(i)
                rows.append(descriptors[:: max(1, len(descriptors) // most)][:most])
                progress.write("indexing features", i + 1, 2 * photographs)
            with replacing(path) as partial:
                np.save(partial, build_vocabulary(np.concatenate(rows)))
        return np.asarray(np.load(path))

    def largest(self, position: int) -> tuple[FeatureIndex, NDArray[np.int64]]:
        """For pair selection: the largest features, and their words for retrieval."""
        first, words = self.stored.descriptors(position)[:LARGEST_FEATURES], self.vocabulary()
        return index_by_word(first, words, FEWEST_COMPARED_SMALL), word_pairs(first, words)

    def _index(self, position: int) -> FeatureIndex:
        return index_by_word(self.stored.descriptors(position), self.vocabulary())


class _Matcher:
    """Matches and verifies pairs in several threads, and writes the results. inliers: of the pairs
    that are matched."""

    def __init__(
        self,
        project: Project,
        database: pycolmap.Database,
        features: _IndexedFeatures,
        known: KnownGeometry | None,
    ) -> None:
        self.features, self._known = features, known
        self.inliers = sqlite.inliers_of_pairs(project.database)
        self._project, self._database = project, database
        self._cameras = cameras_of(project, database)
        self._progress = ProgressWriter(project.database)

    def run(self, wanted: Sequence[Pair]) -> None:
        """Match the `wanted` pairs, except those that are matched."""
        missing = [pair for pair in wanted if pair not in self.inliers]
        done = len(wanted) - len(missing)
        self.features.vocabulary()  # now, and not in several threads at once
        with ThreadPoolExecutor(self._project.threads) as pool:
            for pair, (matches, geometry) in zip(
                missing, pool.map(self._match, missing), strict=True
            ):
                first, second = pair[0] + 1, pair[1] + 1
                self._database.write_matches(first, second, matches)
                self._database.write_two_view_geometry(first, second, geometry)
                self.inliers[pair] = len(geometry.inlier_matches)
                done += 1
                self._progress.write("matching", done, len(wanted))

    def _match(self, pair: Pair) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]:
        """(matches, two-view geometry; without inliers if it has too few)."""
        matches = match_descriptors(*map(self.features.index, pair))
        sides = [(self._cameras[position], self.features.points(position)) for position in pair]
        matched = (points[rows] for (_, points), rows in zip(sides, matches.T, strict=True))
        known = self._known and self._known(pair, matches, *matched)
        return matches, known or two_view_geometry(sides[0], sides[1], matches, self._project.seed)


def cameras_of(project: Project, database: pycolmap.Database) -> list[pycolmap.Camera]:
    """[P] the camera of each photograph."""
    return [database.read_camera(camera + 1) for camera in project.photographs.camera_of]


def _similarity(project: Project, features: _IndexedFeatures) -> NDArray[np.int32]:
    """[P, P] matches among the largest features of the pairs that retrieval proposes; 0 for others.
    Stored for resumed runs."""
    photographs, stored = len(project.photographs), similarity_path(project.database)
    if stored.exists():
        return np.asarray(np.load(stored)["similarity"])
    features.vocabulary()
    progress = ProgressWriter(project.database)
    similarity = np.zeros((photographs, photographs), np.int32)
    indices, words_of = [], []
    with ThreadPoolExecutor(project.threads) as pool:
        for done, (index, words) in enumerate(pool.map(features.largest, range(photographs)), 1):
            indices.append(index)
            words_of.append(words)
            progress.write("indexing features", photographs + done, 2 * photographs)
        wanted = retrieval.candidate_pairs(
            words_of, lambda done: progress.write("retrieving pairs", done, photographs)
        )
        frames = project.photographs.frames
        wanted = [(i, j) for i, j in wanted if frames[i] != frames[j]]

        def count_matches(pair: Pair) -> int:
            return len(match_descriptors(indices[pair[0]], indices[pair[1]]))

        counts = pool.map(count_matches, wanted)
        for done, (pair, count) in enumerate(zip(wanted, counts, strict=True), 1):
            similarity[pair] = count
            progress.write("selecting pairs", done, len(wanted))
    similarity += similarity.T
    with replacing(stored) as partial:
        np.savez_compressed(partial, similarity=similarity)
    return similarity


def two_view_geometry(
    first: tuple[pycolmap.Camera, NDArray[np.float64]],
    second: tuple[pycolmap.Camera, NDArray[np.float64]],
    matches: NDArray[np.uint32],
    seed: int,
) -> pycolmap.TwoViewGeometry:
    """The two-view geometry of two photographs; without inliers if it has too few.

    Args:
        first, second: the camera of a photograph and its keypoints [N, 2].
        matches: [M, 2] indices of keypoints.
        seed: of RANSAC.
    """
    nothing = pycolmap.TwoViewGeometry()
    if len(matches) < FEWEST_INLIERS:
        return nothing
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = MOST_TRIALS
    options.compute_relative_pose = True  # also tells a pure rotation from a planar scene
    found = pycolmap.estimate_two_view_geometry(*first, *second, matches, options)
    return found if len(found.inlier_matches) >= FEWEST_INLIERS else nothing
