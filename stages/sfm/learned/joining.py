"""Joins photographs by learned features, in the worker process (imports pycolmap and torch).

The step copies the database of SIFT's matches, adds learned keypoints after SIFT's, and matches
pairs that may join photographs to the others. SIFT's keypoints and matches stay as they are, so
mapping continues from both.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from stages.base import torch_vml
from stages.sfm.learned.features import LearnedFeatures, XFeat, mutual_nearest
from stages.sfm.learned.matching import LighterGlue
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.features import read_grey
from stages.sfm.worker.job import Learned, Project
from stages.sfm.worker.matching import cameras_of, two_view_geometry
from stages.sfm.worker.pairs import Pair, joining_pairs, without_weaker
from stages.sfm.worker.progress import ProgressWriter

COMPARED = 512  # features of a photograph, the best, for the choice of pairs
LEAST_COSINE = 0.82  # as XFeat's authors have it for matches without LighterGlue
FEWEST_INLIERS = 30  # of a pair; of SIFT's, for a pair that SIFT verifies
_SCALE = 4.0  # of a keypoint, pixels; COLMAP does not use it


def match_learned(job: Learned) -> None:
    """Write the project's database: a copy of `job.source` with learned keypoints, and matches that
    may join the photographs at `job.positions` to the others."""
    torch_vml.warm_up()
    torch.set_num_threads(1)  # photographs and pairs run side by side
    project = job.project
    partial = project.database.with_suffix(".partial.db")
    sqlite.copy(job.source, partial)
    features = _features(project)
    inliers = sqlite.inliers_of_pairs(partial)
    wanted = joining_pairs(_likeness(job, features), inliers, job.positions)
    with (
        closing(sqlite.StoredFeatures(job.source, immutable=True)) as stored,
        pycolmap.Database.open(partial) as database,
    ):
        _write_keypoints(database, features)
        matcher = _Matcher(project.seed, cameras_of(project, database), stored, features)
        inliers = {pair: count for pair, count in inliers.items() if count}
        _write_matches(project, database, matcher, inliers, wanted)
    os.replace(partial, project.database)


def _features(project: Project) -> list[LearnedFeatures]:
    """The learned features of each photograph, by position."""
    network, progress = XFeat(), ProgressWriter(project.database)
    photographs = project.photographs

    def of_photograph(position: int) -> LearnedFeatures:
        mask = photographs.masks[position]
        picture = read_grey(photographs.folder / photographs.names[position])
        return network.features(picture, read_grey(photographs.folder / mask) if mask else None)

    found = []
    with ThreadPoolExecutor(project.threads) as pool:
        for each in pool.map(of_photograph, range(len(photographs))):
            found.append(each)
            progress.write("learned features", len(found), len(photographs))
    return found


def _likeness(job: Learned, features: list[LearnedFeatures]) -> NDArray[np.int32]:
    """[P, P] mutual nearest neighbours among the best features of two photographs; 0 for pairs
    without a photograph at `job.positions`."""
    frames = job.project.photographs.frames
    photographs, progress = len(features), ProgressWriter(job.project.database)
    likeness = np.zeros((photographs, photographs), np.int32)
    for done, i in enumerate(job.positions, 1):
        for j in range(photographs):
            if frames[j] != frames[i] and not likeness[i, j]:
                count = mutual_nearest(features[i], features[j], COMPARED, LEAST_COSINE)
                likeness[i, j] = likeness[j, i] = count
        progress.write("selecting pairs", done, len(job.positions))
    return likeness


def _write_keypoints(database: pycolmap.Database, features: Iterable[LearnedFeatures]) -> None:
    """Add the learned keypoints after SIFT's."""
    for position, each in enumerate(features):
        rows = np.zeros((len(each.points), 4), np.float32)
        rows[:, :2], rows[:, 2] = each.points, _SCALE
        sift = np.asarray(database.read_keypoints(position + 1), np.float32).reshape(-1, 4)
        database.update_keypoints(position + 1, np.concatenate((sift, rows)))


def _write_matches(
    project: Project,
    database: pycolmap.Database,
    matcher: _Matcher,
    inliers: dict[Pair, int],
    wanted: list[Pair],
) -> None:
    """Match the `wanted` pairs, add SIFT's matches, verify both together and write them. A pair
    that only learned features verify gets no geometry if stronger pairs make it redundant.

    inliers: of the pairs that SIFT verified; the `wanted` pairs are added.
    """
    progress = ProgressWriter(project.database)
    found: dict[Pair, tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]] = {}
    uncertain = []
    with ThreadPoolExecutor(project.threads) as pool:
        results = pool.map(matcher.match, wanted)
        for pair, (matches, geometry, by_sift) in zip(wanted, results, strict=True):
            found[pair] = matches, geometry
            inliers[pair] = len(geometry.inlier_matches)
            if by_sift < FEWEST_INLIERS:
                uncertain.append(pair)
            progress.write("learned matching", len(found), len(wanted))
    dropped = without_weaker(inliers, uncertain)
    for pair, (matches, geometry) in found.items():
        ids = pair[0] + 1, pair[1] + 1
        if database.exists_matches(*ids):
            database.delete_matches(*ids)
        if database.exists_two_view_geometry(*ids):
            database.delete_two_view_geometry(*ids)
        enough = inliers[pair] >= FEWEST_INLIERS and pair not in dropped
        database.write_matches(*ids, matches)
        database.write_two_view_geometry(*ids, geometry if enough else pycolmap.TwoViewGeometry())


class _Matcher:
    """Matches and verifies pairs; several threads may use it at once."""

    def __init__(
        self,
        seed: int,
        cameras: list[pycolmap.Camera],
        stored: sqlite.StoredFeatures,
        features: list[LearnedFeatures],
    ) -> None:
        self._seed, self._cameras, self._network = seed, cameras, LighterGlue()
        self._stored, self._features = stored, features

    def match(self, pair: Pair) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry, int]:
        """(matches by SIFT and learned features, two-view geometry, how many of its inliers are
        SIFT's)."""
        sift = self._stored.matches(*pair)
        sift = np.empty((0, 2), np.uint32) if sift is None else sift
        points = [self._stored.points(position) for position in pair]
        starts = np.array([len(each) for each in points], np.uint32)
        learned = self._network.matches(*(self._features[position] for position in pair)) + starts
        matches = np.concatenate((sift, learned))
        first, second = (
            (self._cameras[position], np.concatenate((each, self._features[position].points)))
            for position, each in zip(pair, points, strict=True)
        )
        geometry = two_view_geometry(first, second, matches, self._seed)
        inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        return matches, geometry, int((inliers[:, 0] < starts[0]).sum())
