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
from pathlib import Path

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from stages.base import torch_vml
from stages.sfm.learned.features import LearnedFeatures, XFeat, mutual_nearest
from stages.sfm.learned.matching import LighterGlue
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.features import read_grey
from stages.sfm.worker.job import Job, ProgressWriter
from stages.sfm.worker.matching import two_view_geometry
from stages.sfm.worker.pairs import Pair, joining_pairs, without_weaker

COMPARED = 512  # features of a photograph, the best, for the choice of pairs
LEAST_COSINE = 0.82  # as XFeat's authors have it for matches without LighterGlue
FEWEST_INLIERS = 30  # of a pair; of SIFT's, for a pair that SIFT verifies
_SCALE = 4.0  # of a keypoint, pixels; COLMAP does not use it


def match_learned(job: Job) -> None:
    """Write `job.database`: a copy of `job.source` with learned keypoints, and matches that may
    join `job.photographs` to the others."""
    torch_vml.warm_up()
    torch.set_num_threads(1)  # photographs and pairs run side by side
    partial = Path(job.database).with_suffix(".partial.db")
    sqlite.copy(Path(job.source), partial)
    features = _features(job)
    inliers = sqlite.inliers_of_pairs(partial)
    wanted = joining_pairs(_likeness(job, features), inliers, job.photographs)
    with (
        closing(sqlite.StoredFeatures(Path(job.source), immutable=True)) as stored,
        pycolmap.Database.open(partial) as database,
    ):
        _write_keypoints(database, features)
        _write_matches(job, database, stored, features, wanted)
    os.replace(partial, job.database)


def _features(job: Job) -> list[LearnedFeatures]:
    """The learned features of each photograph, by position."""
    network, root, progress = XFeat(), Path(job.images_root), ProgressWriter(job)

    def of_photograph(position: int) -> LearnedFeatures:
        mask = job.masks[position]
        picture = read_grey(root / job.names[position])
        return network.features(picture, read_grey(root / mask) if mask else None)

    found = []
    with ThreadPoolExecutor(job.threads) as pool:
        for each in pool.map(of_photograph, range(len(job.names))):
            found.append(each)
            progress.write("learned features", len(found), len(job.names))
    return found


def _likeness(job: Job, features: list[LearnedFeatures]) -> NDArray[np.int32]:
    """[P, P] mutual nearest neighbours of the best features of `job.photographs` and all others; 0
    for pairs without one of them."""
    frames = job.frames
    photographs, progress = len(features), ProgressWriter(job)
    likeness = np.zeros((photographs, photographs), np.int32)
    for done, i in enumerate(job.photographs, 1):
        for j in range(photographs):
            if frames[j] != frames[i] and not likeness[i, j]:
                count = mutual_nearest(features[i], features[j], COMPARED, LEAST_COSINE)
                likeness[i, j] = likeness[j, i] = count
        progress.write("selecting pairs", done, len(job.photographs))
    return likeness


def _write_keypoints(database: pycolmap.Database, features: Iterable[LearnedFeatures]) -> None:
    """Add the learned keypoints after SIFT's."""
    for position, each in enumerate(features):
        rows = np.zeros((len(each.points), 4), np.float32)
        rows[:, :2], rows[:, 2] = each.points, _SCALE
        sift = np.asarray(database.read_keypoints(position + 1), np.float32).reshape(-1, 4)
        database.update_keypoints(position + 1, np.concatenate((sift, rows)))


def _write_matches(
    job: Job,
    database: pycolmap.Database,
    stored: sqlite.StoredFeatures,
    features: list[LearnedFeatures],
    wanted: list[Pair],
) -> None:
    """Match the `wanted` pairs, add SIFT's matches, verify both together and write them, but for
    pairs that only learned features verify and that stronger ones make redundant."""
    progress = ProgressWriter(job)
    matcher = _Matcher(job, [database.read_camera(camera + 1) for camera in job.camera_of])
    inliers = sqlite.inliers_of_pairs(Path(job.source))
    inliers = {pair: count for pair, count in inliers.items() if count}
    found: dict[Pair, tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]] = {}
    uncertain = []
    with ThreadPoolExecutor(job.threads) as pool:
        results = pool.map(lambda pair: matcher.match(pair, stored, features), wanted)
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

    def __init__(self, job: Job, cameras: list[pycolmap.Camera]) -> None:
        self._job, self._cameras, self._network = job, cameras, LighterGlue()

    def match(
        self, pair: Pair, stored: sqlite.StoredFeatures, features: list[LearnedFeatures]
    ) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry, int]:
        """(matches by SIFT and learned features, two-view geometry, how many of its inliers are
        SIFT's)."""
        sift = stored.matches(*pair)
        sift = np.empty((0, 2), np.uint32) if sift is None else sift
        points = [stored.points(position) for position in pair]
        starts = np.array([len(each) for each in points], np.uint32)
        learned = self._network.matches(*(features[position] for position in pair)) + starts
        matches = np.concatenate((sift, learned))
        first, second = (
            (self._cameras[position], np.concatenate((each, features[position].points)))
            for position, each in zip(pair, points, strict=True)
        )
        geometry = two_view_geometry(first, second, matches, self._job)
        inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        return matches, geometry, int((inliers[:, 0] < starts[0]).sum())
