"""Camera poses and points from verified matches, in the worker process (imports pycolmap)."""

from __future__ import annotations

import itertools
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.sfm.known.epipolar import MatchedPair, epipolar_distances, inlier_ratios
from stages.sfm.worker.initial_pair import LEAST_ANGLE_DEG, strongest_pair
from stages.sfm.worker.job import Job, ProgressWriter
from stages.sfm.worker.sparse_model import SparseModel, save_model

# A smaller model is compared with the largest one only if it has this many photographs, this share
# of the largest model's photographs, and this many points for each of its photographs.
CREDIBLE_VIEWS, CREDIBLE_SHARE, CREDIBLE_POINTS = 4, 0.1, 20
SMALLEST_MODEL = 3  # photographs; COLMAP's default of 10 would hide a small second scene
MOST_MODELS = 8
LOOSE_INLIERS = 15
PAIR_INLIERS = 30  # pairs with fewer may match by chance and are not held against a model
# An object that was turned before a background that stands still: between photographs before and
# after it, the matches that do not fit the model fit another rotation, the same one in all pairs.
MISFIT_DISTANCE = 0.01  # of the longer side
TURNED_DEG, SAME_TURN_DEG = 20.0, 15.0
FEWEST_TURNED = 5  # pairs; repeated windows around a courtyard gave 3
ROBUST_ADJUSTMENT_ITERATIONS = 25
_LEAST_NOISE = 0.05  # px


def map_photographs(job: Job) -> None:
    """Write the largest model, and the names in each model found, to the folder `job.out`."""
    out = Path(job.out)
    if not out.name:  # "" would be the working directory
        raise ValueError("the job names no folder to leave its model in")
    shutil.rmtree(out, ignore_errors=True)
    scratch = out.with_name(out.name + "-colmap")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    started = time.monotonic()
    models = _incremental(job, scratch)
    timed_out = time.monotonic() - started >= job.max_seconds
    ordered = sorted(
        (m for m in models.values() if m.num_reg_frames() > 0),
        key=lambda m: (-m.num_reg_frames(), -m.num_points3D(), min(m.reg_image_ids())),
    )
    if ordered:
        _robust_bundle_adjustment(ordered[0])
    groups = [_one_name_a_frame(m, job) for m in ordered]
    model = _sparse_model(ordered[0], ordered[1:], job) if ordered else None
    save_model(out, model, groups=groups, timed_out=timed_out)
    shutil.rmtree(scratch, ignore_errors=True)


def _one_name_a_frame(model: pycolmap.Reconstruction, job: Job) -> list[str]:
    """Names of registered photographs; of each panorama, that of one face."""
    ids = sorted(model.reg_image_ids(), reverse=True)
    return sorted({int(job.frames[i - 1]): model.images[i].name for i in ids}.values())


def _robust_bundle_adjustment(model: pycolmap.Reconstruction) -> None:
    """Refine all poses and points once more, with a Cauchy loss.

    The mapper minimises squared errors, which the worst matches dominate: together they bend a long
    arc of cameras. The intrinsics stay fixed, because a change of focal length is nearly the same
    as such a bend, and noise alone would decide between the two.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    model.update_point_3d_errors()
    mean_error_px = model.compute_mean_reprojection_error()
    options.ceres.loss_function_scale = max(mean_error_px, _LEAST_NOISE)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = ROBUST_ADJUSTMENT_ITERATIONS
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _incremental(job: Job, scratch: Path) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # more threads sum residuals in another order each time
    options.random_seed = options.mapper.random_seed = job.seed
    options.triangulation.random_seed = job.seed
    options.mapper.num_threads = 1
    # COLMAP counts images, of which a panorama is twelve: two in common would end a second model.
    images = np.bincount(job.frames)
    options.min_model_size = SMALLEST_MODEL * int(images.min())
    options.max_model_overlap *= int(images.max())
    options.max_num_models = MOST_MODELS
    options.max_runtime_seconds = job.max_seconds
    # Takes an eighth less time than COLMAP's 5 and 2, and gives the same poses.
    options.ba_global_max_refinements, options.ba_local_max_refinements = 3, 1
    # Global bundle adjustment runs each time the model has grown by a fifth (COLMAP: a tenth), and
    # stops once the cost hardly falls; the robust bundle adjustment at the end does the rest.
    # COLMAP waits for gradients to vanish, and those grow with the model.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.2
    options.ba_global_function_tolerance = 1e-4
    options.ba_refine_sensor_from_rig = False  # the faces of a panorama lie exactly
    exact = [number for number, camera in enumerate(job.cameras, 1) if camera.rig]
    options.constant_cameras = options.mapper.constant_cameras = set(exact)
    if job.loose:
        options.mapper.abs_pose_min_num_inliers = LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = 0.15
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 8.0
    if job.strongest_start:
        _start_from_strongest_pair(options, job)
    registered = itertools.count(1)
    progress = ProgressWriter(job)

    def new_model() -> None:
        nonlocal registered
        registered = itertools.count(2)
        one_more()

    def one_more() -> None:
        progress.write("registering photographs", next(registered), int(job.frames.max()) + 1)

    return dict(
        pycolmap.incremental_mapping(
            job.database,
            job.images_root,
            scratch,
            options,
            initial_image_pair_callback=new_model,
            next_image_callback=one_more,
        )
    )


def _start_from_strongest_pair(options: pycolmap.IncrementalPipelineOptions, job: Job) -> None:
    """Start from `initial_pair.strongest_pair`, and make one model: a second one would start from
    the same pair."""
    with pycolmap.Database.open(job.database) as database:
        pair = strongest_pair(job, database, verified_matches(database))
    if pair is not None:
        options.init_image_id1, options.init_image_id2 = pair
        options.mapper.init_min_tri_angle = LEAST_ANGLE_DEG / 2  # COLMAP measures it otherwise
        options.multiple_models = False


def _sparse_model(
    model: pycolmap.Reconstruction, others: list[pycolmap.Reconstruction], job: Job
) -> SparseModel:
    """COLMAP's model as arrays, cameras, photographs and points in order of their ids.

    Args:
        model: the largest model.
        others: the smaller models.
        job: the job that both come from.
    """
    image_ids = sorted(model.reg_image_ids())
    position = {image_id: i for i, image_id in enumerate(image_ids)}
    rotations = [_rotation_between(model, other) for other in others if _credible(other, model)]
    cameras = [
        model.cameras[camera_id + 1]
        for camera_id in range(len(job.cameras))
        if camera_id + 1 in model.cameras
    ]
    camera_position = {camera.camera_id: i for i, camera in enumerate(cameras)}
    return SparseModel(
        names=tuple(model.images[i].name for i in image_ids),
        view_cameras=np.array(
            [camera_position[model.images[i].camera_id] for i in image_ids], np.int32
        ),
        view_frames=job.frames[np.array(image_ids) - 1].astype(np.int32),
        world_to_camera=np.array([_matrix(model.images[i].cam_from_world()) for i in image_ids]),
        camera_sizes=np.array([(c.width, c.height) for c in cameras], np.int32).reshape(-1, 2),
        camera_params=np.array([c.params for c in cameras], np.float64).reshape(-1, 4),
        focal_priors_px=np.array(
            [job.cameras[c.camera_id - 1].focal_px or np.nan for c in cameras], np.float64
        ),
        **point_arrays(model, position),
        **_pair_inlier_ratios(job, model, position),
        rotations_to_others_deg=np.array([r for r in rotations if r is not None], np.float64),
    )


def _credible(other: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> bool:
    """Whether a smaller model is more than a few photographs that fit by chance."""
    views = other.num_reg_frames()
    enough = max(CREDIBLE_VIEWS, CREDIBLE_SHARE * model.num_reg_frames())
    return views >= enough and other.num_points3D() >= CREDIBLE_POINTS * views


def _rotation_between(
    model: pycolmap.Reconstruction, other: pycolmap.Reconstruction
) -> float | None:
    """By how many degrees the two models disagree about the relative rotation of two photographs
    that both registered; the largest over all such pairs. None with fewer than two photographs in
    common."""
    both = sorted(set(model.reg_image_ids()) & set(other.reg_image_ids()))
    ours, theirs = (
        [m.images[image].cam_from_world().rotation.matrix() for image in both]
        for m in (model, other)
    )
    worlds = [a.T @ b for a, b in zip(ours, theirs, strict=True)]  # all equal if the models agree
    cosines = [(np.trace(a.T @ b) - 1.0) / 2.0 for a, b in itertools.combinations(worlds, 2)]
    return float(np.degrees(np.arccos(np.clip(min(cosines), -1.0, 1.0)))) if cosines else None


def _matrix(pose: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3] = pose.matrix()
    return matrix


def point_arrays(model: pycolmap.Reconstruction, position: dict[int, int]) -> dict[str, np.ndarray]:
    """points, colours, observed_points, observing_views and observed_px as in `SparseModel`, points
    in order of their ids. position: index of each registered photograph by image id."""
    points = [model.points3D[point_id] for point_id in sorted(model.point3D_ids())]
    keypoints = {i: model.images[i].points2D for i in position}
    rows = []
    for number, point in enumerate(points):
        for element in point.track.elements:
            x, y = keypoints[element.image_id][element.point2D_idx].xy
            rows.append((number, position[element.image_id], x, y))
    rows.sort()
    table = np.array(rows, np.float64).reshape(-1, 4)
    return {
        "points": np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        "colours": np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        "observed_points": table[:, 0].astype(np.int32),
        "observing_views": table[:, 1].astype(np.int32),
        "observed_px": table[:, 2:],
    }


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


def _pair_inlier_ratios(
    job: Job, model: pycolmap.Reconstruction, position: dict[int, int]
) -> dict[str, np.ndarray]:
    """`pairs`, `pair_inlier_ratios` and `pairs_turned` of `SparseModel`, of the matches that
    two-view geometry verified."""
    progress = ProgressWriter(job)
    normalised: dict[int, np.ndarray] = {}  # undistorted pixels, relative to the principal point
    focal = {i: model.cameras[model.images[i].camera_id].mean_focal_length() for i in position}
    intrinsics = np.array([(focal[i], focal[i], 0.0, 0.0) for i in position])
    poses = np.array([_matrix(model.images[i].cam_from_world()) for i in position])
    side = max(max(c.width, c.height) for c in model.cameras.values())
    pairs, ratios, turns = [], [], []
    with pycolmap.Database.open(job.database) as database:
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
            turns.append(_turn((*pairs[-1], a, b), intrinsics, poses, side, job.seed))
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
    """[3, 3] the rotation of the world between two photographs that those matches show which do not
    fit the model; None if they show none, or hardly any. Arguments as in `epipolar`."""
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
    """Positions of the pairs that agree on one turn, or its inverse: as many as there are, and none
    if these are fewer than `FEWEST_TURNED`."""
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
