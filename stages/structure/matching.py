"""Matches of pairs of photographs, verified, in the worker process (imports pycolmap)."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.structure import database as sqlite
from stages.structure import descriptor_matching, new_database, pairs, retrieval
from stages.structure.job import (
    Job,
    chunks_path,
    compared_pairs_path,
    selected_pairs_path,
    similarity_path,
    vocabulary_path,
)
from stages.structure.pairs import Pair
from stages.structure.vocabulary import (
    SAMPLED_DESCRIPTORS,
    FeatureIndex,
    build_vocabulary,
    index_by_word,
    word_pairs,
)
from stages.structure.worker_progress import ProgressWriter

FIRST_LOOK = 1000  # features: the largest, which are seen from farthest
FIRST_COMPARED = 64  # see `words.COMPARED`; a first look need not be right about single features
FEWEST_INLIERS = 15  # COLMAP's
MOST_TRIALS = 3000  # where few matches fit, as between pictures of other places
_KEPT = 256  # photographs whose sorted features stay in memory


def match_all(job: Job) -> None:
    """Match and verify pairs of photographs; pairs that the database holds are not done again."""
    with _matcher(job, job.database) as matcher:
        for wanted in _rounds(job, matcher.album, matcher.inliers):
            matcher.run(wanted)


def match_pairs(job: Job, wanted: list[Pair]) -> None:
    """Match and verify the `wanted` pairs, less those that the database holds."""
    with _matcher(job, job.database) as matcher:
        matcher.run(wanted)


def select_pairs(job: Job) -> None:
    """Take in what finished shares hold, and leave the pairs to match next (`chosen_path`): none
    once `match` would find nothing to do."""
    database = Path(job.database)
    sqlite.gather(database, sorted(chunks_path(job).glob("*.db")))
    inliers = sqlite.inliers_of_pairs(database)
    missing: list[Pair] = []
    with sqlite.Features(database) as features:
        album = _Album(job, features)
        album.words()  # once, and not in each share
        for wanted in _rounds(job, album, inliers):
            missing = [pair for pair in wanted if pair not in inliers]
            if missing:
                break
    selected_pairs_path(job).write_text(json.dumps(missing))


def match_chunk(job: Job) -> None:
    """Match and verify the job's share of the pairs, into a database of their own."""
    new_database.create(Path(job.database), job, ())
    sqlite.take_cameras(Path(job.database), Path(job.source))
    with _matcher(job, job.source, still=True) as matcher:
        matcher.run(list(job.pairs))


@contextmanager
def _matcher(job: Job, features: str, still: bool = False) -> Iterator[_Matcher]:
    """features: the database that has them, see `database.Features`. Readers leave first: the last
    to close a database puts it in order."""
    with (
        pycolmap.Database.open(job.database) as database,
        sqlite.Features(Path(features), still) as found,
    ):
        yield _Matcher(job, database, found)


def _rounds(job: Job, album: _Album, inliers: Mapping[Pair, int]) -> Iterator[list[Pair]]:
    """Pairs to match, each list once the ones before are matched. inliers: of those that are."""
    photographs = len(job.names)
    if job.matching == "exhaustive":
        yield pairs.exhaustive_pairs(photographs)
    elif job.matching == "sequential":
        yield pairs.sequential_pairs(photographs)
    else:
        alike = _first_look(job, album)
        first = pairs.initial_pairs(alike)
        yield first
        yield pairs.linking_pairs(alike, first, {pair: inliers[pair] for pair in first})


class _Album:
    """The features of photographs by position, sorted by word; read by several threads."""

    def __init__(self, job: Job, features: sqlite.Features) -> None:
        self._job, self._features = job, features
        self.words = functools.cache(self._vocabulary)
        self.sorted = functools.lru_cache(_KEPT)(self._sorted)
        self.points = functools.lru_cache(_KEPT)(features.points)

    def _vocabulary(self) -> NDArray[np.float32]:
        """Of all photographs; kept beside the database, for shares and for another time."""
        path, photographs = vocabulary_path(self._job), len(self._job.names)
        if not path.exists():
            ticks, each = (
                ProgressWriter(Path(self._job.progress)),
                max(1, SAMPLED_DESCRIPTORS // photographs),
            )
            rows = []
            for i in range(photographs):
                rows.append(_spread(self._features.descriptors(i), each))
                ticks.write("sorting features", i + 1, 2 * photographs)
            with replacing(path) as partial:
                np.save(partial, build_vocabulary(np.concatenate(rows)))
        found: NDArray[np.float32] = np.load(path)
        return found

    def largest(self, position: int) -> tuple[FeatureIndex, NDArray[np.int64]]:
        """For a first look: the largest features, and what words they are."""
        first, words = self._features.descriptors(position)[:FIRST_LOOK], self.words()
        return index_by_word(first, words, FIRST_COMPARED), word_pairs(first, words)

    def _sorted(self, position: int) -> FeatureIndex:
        return index_by_word(self._features.descriptors(position), self.words())


class _Matcher:
    """Matches and verifies pairs in several threads, and writes what they find. inliers: of the
    pairs that are matched."""

    def __init__(self, job: Job, database: pycolmap.Database, features: sqlite.Features) -> None:
        self.album = _Album(job, features)
        self.inliers = sqlite.inliers_of_pairs(Path(job.database))
        self._job, self._database, self._features = job, database, features
        self._cameras = [database.read_camera(camera + 1) for camera in job.camera_of]
        self._ticks = ProgressWriter(Path(job.progress))

    def run(self, wanted: list[Pair]) -> None:
        """Match the `wanted` pairs, less those that are matched."""
        missing = [pair for pair in wanted if pair not in self.inliers]
        done = len(wanted) - len(missing)
        self.album.words()  # now, and not in several threads at once
        with ThreadPoolExecutor(self._job.threads) as pool:
            for pair, (matches, geometry) in zip(
                missing, pool.map(self._match, missing), strict=True
            ):
                first, second = pair[0] + 1, pair[1] + 1
                if matches is not None:
                    self._database.write_matches(first, second, matches)
                self._database.write_two_view_geometry(first, second, geometry)
                self.inliers[pair] = len(geometry.inlier_matches)
                done += 1
                self._ticks.write("matching", done, len(wanted))

    def _match(self, pair: Pair) -> tuple[NDArray[np.uint32] | None, pycolmap.TwoViewGeometry]:
        """(matches, None if the database has them, geometry without inliers if it has few)."""
        first, second = pair
        known = self._features.matches(first, second)
        matches = known
        if matches is None:
            matches = descriptor_matching.match_descriptors(
                self.album.sorted(first), self.album.sorted(second)
            )
        geometry = pycolmap.TwoViewGeometry()
        if len(matches) >= FEWEST_INLIERS:
            found = pycolmap.estimate_two_view_geometry(
                self._cameras[first],
                self.album.points(first),
                self._cameras[second],
                self.album.points(second),
                matches,
                _verification(self._job),
            )
            if len(found.inlier_matches) >= FEWEST_INLIERS:
                geometry = found
        return (matches if known is None else None), geometry


def _first_look(job: Job, album: _Album) -> NDArray[np.int32]:
    """[P, P] matches among the largest features of each two photographs that may look alike; none
    of others. It is kept for another time, and how many were looked at for the parent."""
    photographs, kept = len(job.names), similarity_path(job)
    if kept.exists():
        found: NDArray[np.int32] = np.load(kept)["alike"]
        return found
    album.words()
    ticks = ProgressWriter(Path(job.progress))
    alike = np.zeros((photographs, photographs), np.int32)
    sorted_, held = [], []
    with ThreadPoolExecutor(job.threads) as pool:
        for done, (largest, words) in enumerate(pool.map(album.largest, range(photographs)), 1):
            sorted_.append(largest)
            held.append(words)
            ticks.write("sorting features", photographs + done, 2 * photographs)
        wanted = retrieval.candidate_pairs(
            held, lambda done: ticks.write("comparing words", done, photographs)
        )

        def look(pair: Pair) -> int:
            return len(descriptor_matching.match_descriptors(sorted_[pair[0]], sorted_[pair[1]]))

        for done, (pair, count) in enumerate(zip(wanted, pool.map(look, wanted), strict=True), 1):
            alike[pair] = count
            ticks.write("looking for pairs", done, len(wanted))
    compared_pairs_path(job).write_text(str(len(wanted)))
    alike += alike.T
    with replacing(kept) as partial:
        np.savez_compressed(partial, alike=alike)
    return alike


def _spread(rows: NDArray[np.uint8], most: int) -> NDArray[np.uint8]:
    """About `most` of `rows`, evenly taken."""
    return rows[:: max(1, len(rows) // most)][:most]


def _verification(job: Job) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_num_trials = MOST_TRIALS
    options.compute_relative_pose = True  # also tells a turn on the spot from a planar scene
    options.filter_stationary_matches = job.drop_stationary
    return options
