"""Matches of pairs of photographs, verified, in the worker process (imports pycolmap)."""

from __future__ import annotations

import functools
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.structure import database as sqlite
from stages.structure import nearest, pairs, retrieval
from stages.structure.job import Job, looked_path
from stages.structure.pairs import Pair
from stages.structure.ticks import Ticks
from stages.structure.words import SAMPLE, Sorted, sort_by_word, two_words, vocabulary

FIRST_LOOK = 1000  # features: the largest, which are seen from farthest
FIRST_COMPARED = 64  # see `words.COMPARED`; a first look need not be right about single features
FEWEST_INLIERS = 15  # COLMAP's
MOST_TRIALS = 3000  # where few matches fit, as between pictures of other places
_KEPT = 256  # photographs whose sorted features stay in memory


def match(job: Job) -> None:
    """Match and verify pairs of photographs; pairs that the database holds are not done again."""
    photographs = len(job.names)
    known = sqlite.inliers_of_pairs(Path(job.database))
    with pycolmap.Database.open(job.database) as database:
        matcher = _Matcher(job, database, known)
        if job.matching == "exhaustive":
            matcher.run(pairs.every(photographs))
        elif job.matching == "sequential":
            matcher.run(pairs.sequential(photographs))
        else:
            alike = _first_look(job, matcher.album)
            first = pairs.promising(alike)
            inliers = matcher.run(first)
            matcher.run(pairs.closing_gaps(alike, first, inliers))


def match_pairs(job: Job, wanted: list[Pair]) -> None:
    """Match and verify the `wanted` pairs, less those that the database holds."""
    known = sqlite.inliers_of_pairs(Path(job.database))
    with pycolmap.Database.open(job.database) as database:
        _Matcher(job, database, known).run(wanted)


class _Album:
    """The features of photographs by position, sorted by word; read by several threads."""

    def __init__(self, database: pycolmap.Database, photographs: int, ticks: Ticks) -> None:
        self.lock = threading.Lock()  # around all use of the database
        self._database = database
        each = max(1, SAMPLE // photographs)
        rows = []
        for i in range(photographs):
            rows.append(_spread(self.descriptors(i), each))
            ticks.write("sorting features", i + 1, 2 * photographs)
        self._words = vocabulary(np.concatenate(rows))
        self.sorted = functools.lru_cache(_KEPT)(self._sorted)
        self.points = functools.lru_cache(_KEPT)(self._points)

    def descriptors(self, position: int) -> NDArray[np.uint8]:
        """[N, 128], largest features first."""
        with self.lock:
            return np.asarray(self._database.read_descriptors(position + 1).data).reshape(-1, 128)

    def _points(self, position: int) -> NDArray[np.float64]:
        """[N, 2] x, y of features."""
        with self.lock:
            return self._database.read_keypoints(position + 1)[:, :2].astype(np.float64)

    def largest(self, position: int) -> tuple[Sorted, NDArray[np.int64]]:
        """For a first look: the largest features, and what words they are."""
        first = self.descriptors(position)[:FIRST_LOOK]
        return sort_by_word(first, self._words, FIRST_COMPARED), two_words(first, self._words)

    def _sorted(self, position: int) -> Sorted:
        return sort_by_word(self.descriptors(position), self._words)


class _Matcher:
    """Matches and verifies pairs in several threads, and writes what they find."""

    def __init__(self, job: Job, database: pycolmap.Database, inliers: dict[Pair, int]) -> None:
        self._ticks = Ticks(Path(job.progress))
        self.album = _Album(database, len(job.names), self._ticks)
        self._job, self._database, self._inliers = job, database, inliers
        self._cameras = [database.read_camera(camera + 1) for camera in job.camera_of]

    def run(self, wanted: list[Pair]) -> dict[Pair, int]:
        """Inliers of each of the `wanted` pairs."""
        missing = [pair for pair in wanted if pair not in self._inliers]
        done = len(wanted) - len(missing)
        with ThreadPoolExecutor(self._job.threads) as pool:
            for pair, (matches, geometry) in zip(
                missing, pool.map(self._match, missing), strict=True
            ):
                self._write(pair, matches, geometry)
                self._inliers[pair] = len(geometry.inlier_matches)
                done += 1
                self._ticks.write("matching", done, len(wanted))
        return {pair: self._inliers[pair] for pair in wanted}

    def _match(self, pair: Pair) -> tuple[NDArray[np.uint32] | None, pycolmap.TwoViewGeometry]:
        """(matches, None if the database has them, geometry without inliers if it has few)."""
        first, second = pair
        with self.album.lock:
            known = self._database.exists_matches(first + 1, second + 1)
            matches = self._database.read_matches(first + 1, second + 1) if known else None
        if matches is None:
            matches = nearest.matches(self.album.sorted(first), self.album.sorted(second))
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
        return (None if known else matches), geometry

    def _write(
        self, pair: Pair, matches: NDArray[np.uint32] | None, geometry: pycolmap.TwoViewGeometry
    ) -> None:
        first, second = pair[0] + 1, pair[1] + 1
        with self.album.lock:
            if matches is not None:
                self._database.write_matches(first, second, matches)
            self._database.write_two_view_geometry(first, second, geometry)


def _first_look(job: Job, album: _Album) -> NDArray[np.int32]:
    """[P, P] matches among the largest features of each two photographs that may look alike; none
    of others. How many were looked at is left for the parent."""
    photographs = len(job.names)
    ticks = Ticks(Path(job.progress))
    alike = np.zeros((photographs, photographs), np.int32)
    sorted_, held = [], []
    with ThreadPoolExecutor(job.threads) as pool:
        for done, (largest, words) in enumerate(pool.map(album.largest, range(photographs)), 1):
            sorted_.append(largest)
            held.append(words)
            ticks.write("sorting features", photographs + done, 2 * photographs)
        wanted = retrieval.candidates(
            held, lambda done: ticks.write("comparing words", done, photographs)
        )

        def look(pair: Pair) -> int:
            return len(nearest.matches(sorted_[pair[0]], sorted_[pair[1]]))

        for done, (pair, count) in enumerate(zip(wanted, pool.map(look, wanted), strict=True), 1):
            alike[pair] = count
            ticks.write("looking for pairs", done, len(wanted))
    looked_path(job).write_text(str(len(wanted)))
    return alike + alike.T


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
