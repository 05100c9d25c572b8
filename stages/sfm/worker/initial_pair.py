"""The pair of photographs that a second attempt at mapping starts from, in the worker process.

COLMAP starts from the photograph with most matches and another one whose rays meet its own at 16
degrees. On a slow walk around a scene neighbours see each other at a few degrees, so it takes two
photographs of different rounds, which share little of their pictures. If their relative pose is
wrong, the photographs that follow are registered to a bent model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.sfm.worker.job import Project
from stages.sfm.worker.progress import ProgressWriter

LEAST_ANGLE_DEG = 8.0  # median angle at which the rays of the matches meet: half of COLMAP's
MOST_FORWARD = 0.95  # share of the motion that is along the optical axis, as in COLMAP
_MOST_TRIALS = 500  # of RANSAC: nearly all of these matches are right


def strongest_pair(
    project: Project,
    database: pycolmap.Database,
    verified: Sequence[tuple[tuple[int, int], NDArray[np.integer]]],
) -> tuple[int, int] | None:
    """Image ids of the pair with most matches among those with enough parallax, or None. The faces
    of a panorama are no pair. verified: both image ids and the matches [N, 2] of each pair."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_num_trials = project.seed, _MOST_TRIALS
    options.compute_relative_pose = True
    progress = ProgressWriter(project.database)
    frames = project.photographs.frames
    ordered = sorted(verified, key=lambda pair: (-len(pair[1]), pair[0]))
    for done, (both, matches) in enumerate(ordered, 1):
        progress.write("choosing the initial pair", done, len(ordered))
        if frames[both[0] - 1] == frames[both[1] - 1]:
            continue
        first, second = (database.read_camera(database.read_image(i).camera_id) for i in both)
        a, b = (database.read_keypoints(i)[:, :2].astype(np.float64) for i in both)
        found = pycolmap.estimate_calibrated_two_view_geometry(
            first, a, second, b, matches.astype(np.uint32), options
        )
        if found.cam2_from_cam1 is None:
            continue
        move = found.cam2_from_cam1.translation
        sideways = abs(move[2]) < MOST_FORWARD * np.linalg.norm(move)
        if sideways and np.degrees(found.tri_angle) >= LEAST_ANGLE_DEG:
            return both
    return None
