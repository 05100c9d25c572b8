"""Camera poses and points from the matches, in the worker process (imports pycolmap)."""

from __future__ import annotations

import itertools
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from stages.structure import database as sqlite
from stages.structure.epipolar import inlier_ratios
from stages.structure.job import Job
from stages.structure.placing import Placing
from stages.structure.sparse_model import SparseModel, save_model
from stages.structure.worker_progress import ProgressWriter

# Of a smaller model that may contradict the largest.
CREDIBLE_VIEWS, CREDIBLE_SHARE, CREDIBLE_POINTS = 4, 0.1, 20  # points: for each view
SMALLEST_MODEL = 3  # photographs; COLMAP's own 10 hides a second scene without a word
MOST_MODELS = 8
LOOSE_INLIERS = 15
PAIR_INLIERS = 30  # fewer may be chance, and say nothing against a model
ROBUST_ADJUSTMENT_ITERATIONS = 25
_LEAST_NOISE = 0.05  # px


def map_photographs(job: Job) -> None:
    """Write the largest model to `job.out`, with the names in each model that was found."""
    out = Path(job.out)
    if not out.name:  # "" is the folder that the process happens to stand in
        raise ValueError("the job names no folder to leave its model in")
    shutil.rmtree(out, ignore_errors=True)
    scratch = out.with_name(out.name + "-colmap")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    started = time.monotonic()
    with Placing(ProgressWriter(Path(job.progress)), len(job.names)) as placing:
        if job.mapper == "global":
            models = _global(job, scratch)
        else:
            models = _incremental(job, scratch, placing)
        timed_out = job.mapper != "global" and time.monotonic() - started >= job.max_seconds
        ordered = sorted(
            (m for m in models.values() if m.num_reg_images() > 0),
            key=lambda m: (-m.num_reg_images(), -m.num_points3D(), min(m.reg_image_ids())),
        )
        if ordered:
            placing.ending()
            _settle(ordered[0])
    groups = [sorted(m.images[i].name for i in m.reg_image_ids()) for m in ordered]
    model = _plain(ordered[0], ordered[1:], job) if ordered else None
    save_model(out, model, groups=groups, timed_out=timed_out)
    shutil.rmtree(scratch, ignore_errors=True)


def _settle(model: pycolmap.Reconstruction) -> None:
    """Move all of it to where most of what is seen wants it. The mapper adjusts by plain least
    squares, in which the worst matches pull hardest, and together bend a long arc of cameras. The
    lens stays: a focal length hardly differs from a bend, and moved either way by chance."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    model.update_point_3d_errors()
    usual = model.compute_mean_reprojection_error()
    options.ceres.loss_function_scale = max(usual, _LEAST_NOISE)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = ROBUST_ADJUSTMENT_ITERATIONS
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _incremental(job: Job, scratch: Path, placing: Placing) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # more threads sum residuals in another order each time
    options.random_seed = options.mapper.random_seed = job.seed
    options.triangulation.random_seed = job.seed
    options.mapper.num_threads = 1
    options.min_model_size = SMALLEST_MODEL
    options.max_num_models = MOST_MODELS
    options.max_runtime_seconds = job.max_seconds
    # An eighth of the time less than COLMAP's 5 and 2, and the same poses.
    options.ba_global_max_refinements, options.ba_local_max_refinements = 3, 1
    # All cameras are adjusted after each fifth photograph more, not each tenth, and only until that
    # gains next to nothing: what is left, settling does. COLMAP goes on until gradients vanish that
    # grow with the model.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.2
    options.ba_global_function_tolerance = 1e-4
    if job.loose:
        options.mapper.abs_pose_min_num_inliers = LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = 0.15
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 8.0
    if job.other_pair:
        pair = _other_pair(Path(job.database))
        if pair is not None:
            options.init_image_id1, options.init_image_id2 = pair
            options.multiple_models = False
            options.mapper.init_min_tri_angle = 4.0
    return dict(
        pycolmap.incremental_mapping(
            job.database,
            job.images_root,
            scratch,
            options,
            initial_image_pair_callback=placing.began,
            next_image_callback=placing.placed,
        )
    )


def _global(job: Job, scratch: Path) -> dict[int, pycolmap.Reconstruction]:
    database = scratch / "database.db"  # calibration rewrites the two-view geometries
    sqlite.copy(Path(job.database), database)
    if any(camera.focal_px is None for camera in job.cameras):
        pycolmap.calibrate_view_graph(database)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = job.seed
    options.mapper.num_threads = 1
    options.mapper.rotation_averaging.random_seed = job.seed
    options.mapper.global_positioning.random_seed = job.seed
    options.mapper.retriangulation.random_seed = job.seed
    models = dict(pycolmap.global_mapping(database, job.images_root, scratch, options))
    for model in models.values():
        model.normalize()
        model.extract_colors_for_all_images(job.images_root, num_threads=1)
    return models


def _other_pair(database: Path) -> tuple[int, int] | None:
    """Image ids of the calibrated pair with most inliers among pairs that are far apart in the
    order of shooting, which COLMAP, looking for most inliers, tries last."""
    pairs = [pair for pair in sqlite.verified_pairs(database) if pair[3] == 2]
    far = [pair for pair in pairs if pair[1] - pair[0] >= 2] or pairs
    if not far:
        return None
    first, second, _, _ = max(far, key=lambda pair: (pair[2], -pair[0], -pair[1]))
    return first + 1, second + 1


def _plain(
    model: pycolmap.Reconstruction, others: list[pycolmap.Reconstruction], job: Job
) -> SparseModel:
    """COLMAP's model as arrays, everything in order of ids. others: smaller models."""
    image_ids = sorted(model.reg_image_ids())
    position = {image_id: i for i, image_id in enumerate(image_ids)}
    point_ids = sorted(model.point3D_ids())
    points = [model.points3D[point_id] for point_id in point_ids]
    seen = observations(model, points, position)
    pairs = _pairs(job, model, position)
    turns = [_turn_between(model, other) for other in others if _credible(other, model)]
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
        world_to_camera=np.array([_matrix(model.images[i].cam_from_world()) for i in image_ids]),
        camera_sizes=np.array([(c.width, c.height) for c in cameras], np.int32).reshape(-1, 2),
        camera_params=np.array([c.params for c in cameras], np.float64).reshape(-1, 4),
        focal_priors_px=np.array(
            [job.cameras[c.camera_id - 1].focal_px or np.nan for c in cameras], np.float64
        ),
        points=np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        colours=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        **seen,
        **pairs,
        turns_of_others=np.array([turn for turn in turns if turn is not None], np.float64),
    )


def _credible(other: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> bool:
    """Whether a smaller model is more than a few photographs that happened to fit."""
    views = other.num_reg_images()
    enough = max(CREDIBLE_VIEWS, CREDIBLE_SHARE * model.num_reg_images())
    return views >= enough and other.num_points3D() >= CREDIBLE_POINTS * views


def _turn_between(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> float | None:
    """Degrees between what the two say of the directions of photographs that both placed, the
    largest over pairs of them; None with fewer than two."""
    both = sorted(set(model.reg_image_ids()) & set(other.reg_image_ids()))
    ours, theirs = (
        [m.images[image].cam_from_world().rotation.matrix() for image in both]
        for m in (model, other)
    )
    worlds = [a.T @ b for a, b in zip(ours, theirs, strict=True)]  # the same, if both are right
    cosines = [(np.trace(a.T @ b) - 1.0) / 2.0 for a, b in itertools.combinations(worlds, 2)]
    return float(np.degrees(np.arccos(np.clip(min(cosines), -1.0, 1.0)))) if cosines else None


def _matrix(pose: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3] = pose.matrix()
    return matrix


def observations(
    model: pycolmap.Reconstruction, points: list[Any], position: dict[int, int]
) -> dict[str, np.ndarray]:
    keypoints = {i: model.images[i].points2D for i in position}
    rows = []
    for number, point in enumerate(points):
        for element in point.track.elements:
            x, y = keypoints[element.image_id][element.point2D_idx].xy
            rows.append((number, position[element.image_id], x, y))
    rows.sort()
    table = np.array(rows, np.float64).reshape(-1, 4)
    return {
        "observed_points": table[:, 0].astype(np.int32),
        "observing_views": table[:, 1].astype(np.int32),
        "observed_px": table[:, 2:],
    }


def _pairs(
    job: Job, model: pycolmap.Reconstruction, position: dict[int, int]
) -> dict[str, np.ndarray]:
    """How many of the matches that two photographs alone agree on fit the model."""
    ticks = ProgressWriter(Path(job.progress))
    straight: dict[int, np.ndarray] = {}  # pixels of a pinhole without a principal point
    focal = {i: model.cameras[model.images[i].camera_id].mean_focal_length() for i in position}
    lenses = np.array([(focal[i], focal[i], 0.0, 0.0) for i in position])
    poses = np.array([_matrix(model.images[i].cam_from_world()) for i in position])
    side = max(max(c.width, c.height) for c in model.cameras.values())
    pairs, shares = [], []
    with pycolmap.Database.open(job.database) as database:
        ids, geometries = database.read_two_view_geometries()
        for done, (pair_id, geometry) in enumerate(zip(ids, geometries, strict=True), 1):
            both = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.asarray(geometry.inlier_matches)
            ticks.write("checking pairs", done, len(ids))
            if len(matches) < PAIR_INLIERS or any(image not in position for image in both):
                continue
            for image in both:
                if image not in straight:
                    camera = model.cameras[model.images[image].camera_id]
                    pixels = database.read_keypoints(image)[:, :2].astype(np.float64)
                    straight[image] = focal[image] * np.asarray(camera.cam_from_img(pixels))
            a, b = (straight[image][matches[:, k]] for k, image in enumerate(both))
            pairs.append((position[both[0]], position[both[1]]))
            shares += inlier_ratios([(*pairs[-1], a, b)], lenses, poses, side).tolist()
    return {
        "pairs": np.array(pairs, np.int32).reshape(-1, 2),
        "pair_fits": np.nan_to_num(np.array(shares, np.float64), nan=1.0),
    }
