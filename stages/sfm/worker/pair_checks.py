"""Which verified pairs fit the poses of a model, in the worker process (imports pycolmap)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.sfm.known.epipolar import MatchedPair, epipolar_distances, inlier_ratios
from stages.sfm.worker.job import Project
from stages.sfm.worker.progress import ProgressWriter

PAIR_INLIERS = 30  # pairs with fewer may match by chance and are not held against a model
# An object that was turned before a background that stands still: between photographs before and
# after it, the matches that do not fit the model fit another rotation, the same one in all pairs.
MISFIT_DISTANCE = 0.01  # of the longer side
TURNED_DEG, SAME_TURN_DEG = 20.0, 15.0
FEWEST_TURNED = 5  # pairs; repeated windows around a courtyard gave 3


def pose_matrix(image: pycolmap.Image) -> np.ndarray:
    """[4, 4] world to camera of a registered photograph."""
    matrix = np.eye(4)
    matrix[:3] = image.cam_from_world().matrix()
    return matrix


def verified_matches(
    database: pycolmap.Database,
) -> list[tuple[tuple[int, int], NDArray[np.integer]]]:
    """(both image ids, keypoints that match [N, 2]) of each pair with enough matches that two-view
    geometry verified."""
    found = [
        (pycolmap.pair_id_to_image_pair(pair_id), np.asarray(geometry.inlier_matches))
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True)
    ]
    return [(both, inliers) for both, inliers in found if len(inliers) >= PAIR_INLIERS]


def pair_arrays(
    project: Project, model: pycolmap.Reconstruction, position: dict[int, int]
) -> dict[str, np.ndarray]:
    """pairs, pair_inlier_ratios and pairs_turned as in `SparseModel`. position: index of each
    registered photograph by image id."""
    progress = ProgressWriter(project.database)
    normalised: dict[int, np.ndarray] = {}  # undistorted pixels, relative to the principal point
    focal = {i: model.cameras[model.images[i].camera_id].mean_focal_length() for i in position}
    intrinsics = np.array([(focal[i], focal[i], 0.0, 0.0) for i in position])
    poses = np.array([pose_matrix(model.images[i]) for i in position])
    side = max(max(c.width, c.height) for c in model.cameras.values())
    pairs, ratios, turns = [], [], []
    with pycolmap.Database.open(project.database) as database:
        verified = verified_matches(database)
        for done, (both, inliers) in enumerate(verified, 1):
            progress.write("checking pairs", done, len(verified))
            if any(image not in position for image in both):
                continue
            for image in both:
                if image not in normalised:
                    camera = model.cameras[model.images[image].camera_id]
                    pixels = database.read_keypoints(image)[:, :2].astype(np.float64)
                    normalised[image] = focal[image] * np.asarray(camera.cam_from_img(pixels))
            pairs.append((position[both[0]], position[both[1]]))
            a, b = (normalised[image][inliers[:, k]] for k, image in enumerate(both))
            ratios += inlier_ratios([(*pairs[-1], a, b)], intrinsics, poses, side).tolist()
            matches = database.read_matches(*both)
            a, b = (normalised[image][matches[:, k]] for k, image in enumerate(both))
            turns.append(_turn((*pairs[-1], a, b), intrinsics, poses, side, project.seed))
    found = np.nan_to_num(np.array(ratios, np.float64), nan=1.0)
    turned = np.zeros(len(pairs), np.bool_)
    turned[_turned_pairs(turns)] = True
    checked = np.array(pairs, np.int32).reshape(-1, 2)
    return {"pairs": checked, "pair_inlier_ratios": found, "pairs_turned": turned}


def _turn(
    pair: MatchedPair,
    intrinsics: NDArray[np.float64],
    poses: NDArray[np.float64],
    side: float,
    seed: int,
) -> NDArray[np.float64] | None:
    """[3, 3] by how much the scene is turned between two photographs, according to the matches that
    do not fit the model; None if they show no turn, or a small one. Arguments as in
    `known.epipolar`."""
    away = epipolar_distances(pair, intrinsics, poses)
    if away is None:
        return None
    misfit = away > MISFIT_DISTANCE * side
    (first, second), (a, b) = pair[:2], (px[misfit] for px in pair[2:])
    if len(a) < PAIR_INLIERS:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_num_trials = seed, 1000
    options.compute_relative_pose = True
    left, right = (
        pycolmap.Camera(model="PINHOLE", width=1, height=1, params=intrinsics[i])
        for i in (first, second)
    )
    order = np.repeat(np.arange(len(a), dtype=np.uint32)[:, None], 2, axis=1)
    found = pycolmap.estimate_two_view_geometry(left, a, right, b, order, options)
    if len(found.inlier_matches) < PAIR_INLIERS or found.cam2_from_cam1 is None:
        return None
    relative = found.cam2_from_cam1.rotation.matrix()
    turn = poses[second, :3, :3].T @ relative @ poses[first, :3, :3]
    small = np.trace(turn) > 1.0 + 2.0 * np.cos(np.radians(TURNED_DEG))
    return None if small else np.asarray(turn, np.float64)


def _turned_pairs(turns: Sequence[NDArray[np.float64] | None]) -> list[int]:
    """Positions of the pairs in the largest group that agrees on one turn or its inverse; none if
    the group is smaller than `FEWEST_TURNED`."""
    known = [i for i, turn in enumerate(turns) if turn is not None]
    if len(known) < FEWEST_TURNED:
        return []
    all_turns = np.array([turns[i] for i in known])
    traces = np.maximum(
        np.einsum("aij,bij->ab", all_turns, all_turns),
        np.einsum("aij,bji->ab", all_turns, all_turns),
    )
    agree = traces > 1.0 + 2.0 * np.cos(np.radians(SAME_TURN_DEG))
    best = np.flatnonzero(agree[agree.sum(axis=1).argmax()])
    return [known[i] for i in best] if len(best) >= FEWEST_TURNED else []
