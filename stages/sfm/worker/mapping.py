"""Camera poses and points from verified matches, in the worker process (imports pycolmap)."""

from __future__ import annotations

import itertools
import shutil
import time
from pathlib import Path

import numpy as np
import pycolmap

from stages.sfm.worker.initial_pair import LEAST_ANGLE_DEG, strongest_pair
from stages.sfm.worker.job import Mapping, Project
from stages.sfm.worker.pair_checks import pair_arrays, pose_matrix, verified_matches
from stages.sfm.worker.progress import ProgressWriter
from stages.sfm.worker.sparse_model import SparseModel, save_model

# A smaller model is compared with the largest one only if it has this many photographs, this share
# of the largest model's photographs, and this many points for each of its photographs.
CREDIBLE_VIEWS, CREDIBLE_SHARE, CREDIBLE_POINTS = 4, 0.1, 20
SMALLEST_MODEL = 3  # photographs; COLMAP's default of 10 would hide a small second scene
MOST_MODELS = 8
LOOSE_INLIERS = 15
ROBUST_ADJUSTMENT_ITERATIONS = 25
_LEAST_NOISE = 0.05  # px


def map_photographs(job: Mapping) -> None:
    """Write the largest model, and the names in each model found, to the folder `job.out`."""
    out = job.out
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
    groups = [_one_name_a_frame(m, job.project) for m in ordered]
    model = _sparse_model(ordered[0], ordered[1:], job.project) if ordered else None
    save_model(out, model, groups=groups, timed_out=timed_out)
    shutil.rmtree(scratch, ignore_errors=True)


def _one_name_a_frame(model: pycolmap.Reconstruction, project: Project) -> list[str]:
    """Names of registered photographs; of each panorama, that of one face."""
    ids, frame_of = sorted(model.reg_image_ids(), reverse=True), project.photographs.frame_of
    return sorted({frame_of[i - 1]: model.images[i].name for i in ids}.values())


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


def _incremental(job: Mapping, scratch: Path) -> dict[int, pycolmap.Reconstruction]:
    project, photographs = job.project, job.project.photographs
    registered = itertools.count(1)
    progress = ProgressWriter(project.database)

    def new_model() -> None:
        nonlocal registered
        registered = itertools.count(2)
        one_more()

    def one_more() -> None:
        frames = max(photographs.frame_of) + 1
        progress.write("registering photographs", next(registered), frames)

    return dict(
        pycolmap.incremental_mapping(
            project.database,
            photographs.folder,
            scratch,
            _options(job),
            initial_image_pair_callback=new_model,
            next_image_callback=one_more,
        )
    )


def _options(job: Mapping) -> pycolmap.IncrementalPipelineOptions:
    project, photographs = job.project, job.project.photographs
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # more threads sum residuals in another order each time
    options.random_seed = options.mapper.random_seed = project.seed
    options.triangulation.random_seed = project.seed
    options.mapper.num_threads = 1
    # COLMAP counts images, and a panorama is twelve: two in common would end a second model.
    images = np.bincount(photographs.frames)
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
    exact = [number for number, camera in enumerate(photographs.cameras, 1) if camera.rig]
    options.constant_cameras = options.mapper.constant_cameras = set(exact)
    if job.loose:
        options.mapper.abs_pose_min_num_inliers = LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = 0.15
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 8.0
    if job.strongest_start:
        _start_from_strongest_pair(options, project)
    return options


def _start_from_strongest_pair(
    options: pycolmap.IncrementalPipelineOptions, project: Project
) -> None:
    """Start from `initial_pair.strongest_pair`, and make one model: a second one would start from
    the same pair."""
    with pycolmap.Database.open(project.database) as database:
        pair = strongest_pair(project, database, verified_matches(database))
    if pair is not None:
        options.init_image_id1, options.init_image_id2 = pair
        options.mapper.init_min_tri_angle = LEAST_ANGLE_DEG / 2  # COLMAP measures it otherwise
        options.multiple_models = False


def _sparse_model(
    model: pycolmap.Reconstruction, others: list[pycolmap.Reconstruction], project: Project
) -> SparseModel:
    """COLMAP's model as arrays, cameras, photographs and points in order of their ids.

    Args:
        model: the largest model.
        others: the smaller models.
        project: that both come from.
    """
    image_ids, photographs = sorted(model.reg_image_ids()), project.photographs
    position = {image_id: i for i, image_id in enumerate(image_ids)}
    rotations = [_rotation_between(model, other) for other in others if _credible(other, model)]
    cameras = [
        model.cameras[camera_id + 1]
        for camera_id in range(len(photographs.cameras))
        if camera_id + 1 in model.cameras
    ]
    camera_position = {camera.camera_id: i for i, camera in enumerate(cameras)}
    return SparseModel(
        names=tuple(model.images[i].name for i in image_ids),
        view_cameras=np.array(
            [camera_position[model.images[i].camera_id] for i in image_ids], np.int32
        ),
        view_frames=photographs.frames[np.array(image_ids) - 1].astype(np.int32),
        world_to_camera=np.array([pose_matrix(model.images[i]) for i in image_ids]),
        camera_sizes=np.array([(c.width, c.height) for c in cameras], np.int32).reshape(-1, 2),
        camera_params=np.array([c.params for c in cameras], np.float64).reshape(-1, 4),
        focal_priors_px=np.array(
            [photographs.cameras[c.camera_id - 1].focal_px or np.nan for c in cameras], np.float64
        ),
        **point_arrays(model, position),
        **pair_arrays(project, model, position),
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
