"""Matches and points for known cameras, in the worker process (imports pycolmap)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.cameras.camera_file import poses_of
from stages.scene.rotations import similarity
from stages.sfm.known.epipolar import (
    INLIER_DISTANCE,
    ROUGH,
    PoseCheck,
    epipolar_distances,
    inlier_ratios,
    median_inlier_ratio,
    misfits,
    upside_down,
)
from stages.sfm.worker.job import CameraGuess, KnownCameras, Neighbours, Project, Triangulation
from stages.sfm.worker.mapping import point_arrays
from stages.sfm.worker.matching import FEWEST_INLIERS, Pixels, match_pairs
from stages.sfm.worker.pair_checks import verified_matches
from stages.sfm.worker.pairs import Pair
from stages.sfm.worker.sparse_model import camera_centres

FITTING = 0.5  # of the matches of a pair must fit the poses to be believed; by chance 1 % do
# Factor on COLMAP's error thresholds of triangulation, for each round of refinement: with the usual
# thresholds, rough poses give no points to begin with.
REFINEMENTS = (8.0, 4.0, 2.0, 1.0, 1.0)


def match_neighbours(job: Neighbours) -> None:
    """Match and verify the selected pairs, with the exact intrinsics of the known cameras."""
    guesses = job.project.photographs.cameras
    with pycolmap.Database.open(job.project.database) as database:
        for camera in _cameras(guesses, job.cameras.intrinsics):
            database.update_camera(camera)
    match_pairs(job.project, job.pairs, partial(_posed_geometry, job.cameras, _side(guesses)))


def _posed_geometry(
    known: KnownCameras,
    side: float,
    pair: Pair,
    matches: NDArray[np.uint32],
    first: Pixels,
    second: Pixels,
) -> pycolmap.TwoViewGeometry | None:
    """The matches that lie roughly where the poses predict them, if enough lie there exactly; else
    None. RANSAC finds the same in twenty times the time."""
    distances = epipolar_distances((*pair, first, second), known.intrinsics, known.world_to_camera)
    fewest = max(FEWEST_INLIERS, FITTING * len(matches))
    if distances is None or np.sum(distances < INLIER_DISTANCE * side) < fewest:
        return None
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = matches[distances < ROUGH * INLIER_DISTANCE * side]
    return geometry


def triangulate(job: Triangulation) -> None:
    """Check the poses against the matches, and triangulate points with the poses held fixed.

    Writes to `job.out`: pose_check.json (`epipolar.PoseCheck`), and points.npz with points,
    observations and poses.
    """
    lens, poses, out = job.cameras.intrinsics, job.cameras.world_to_camera, job.out
    photographs = job.project.photographs
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pairs = _matched_points(job.project.database)
    side = _side(photographs.cameras)
    check = PoseCheck(
        pairs=len(pairs),
        given=median_inlier_ratio(pairs, lens, poses, side),
        rough=median_inlier_ratio(pairs, lens, poses, ROUGH * side),
    )
    if job.refine:
        poses = _refined(job, out / "colmap")
        check = replace(check, refined=median_inlier_ratio(pairs, lens, poses, side))
    bad = misfits(pairs, inlier_ratios(pairs, lens, poses, side), photographs.frame_of)
    sizes = np.array([(camera.width, camera.height) for camera in photographs.cameras], np.float64)
    turned = upside_down(pairs, lens, poses, sizes, photographs.frame_of, bad)
    check = replace(check, misfits=bad, upside_down=turned)
    (out / "pose_check.json").write_text(json.dumps(vars(check)), encoding="utf-8")
    _save_points(_triangulated(job, poses, out / "colmap"), poses, out / "points.npz")


def _side(guesses: Sequence[CameraGuess]) -> float:
    """The longer side of the largest picture, in pixels."""
    return float(max(max(camera.width, camera.height) for camera in guesses))


def _cameras(
    guesses: Sequence[CameraGuess], intrinsics: NDArray[np.float64]
) -> Iterator[pycolmap.Camera]:
    """The pinhole cameras of all views; their ids are positions + 1."""
    known = zip(guesses, intrinsics, strict=True)
    for number, (guess, params) in enumerate(known, 1):
        size = {"width": guess.width, "height": guess.height}
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", params=params, **size)
        camera.has_prior_focal_length = True
        yield camera


def _matched_points(path: Path) -> list[tuple[int, int, NDArray[np.float64], NDArray[np.float64]]]:
    """(first, second, pixels in the first [N, 2], in the second) of each pair of
    `verified_matches`, which does not depend on the given poses."""
    found = []
    with pycolmap.Database.open(path) as database:
        keypoints: dict[int, NDArray[np.float64]] = {}
        for (first, second), matches in verified_matches(database):
            for image in (first, second):
                if image not in keypoints:
                    keypoints[image] = database.read_keypoints(image)[:, :2].astype(np.float64)
            a, b = keypoints[first][matches[:, 0]], keypoints[second][matches[:, 1]]
            found.append((first - 1, second - 1, a, b))
    return found


def _refined(job: Triangulation, scratch: Path) -> NDArray[np.float64]:
    """[V, 4, 4] the given poses after rounds of triangulation and bundle adjustment, with fixed
    intrinsics.

    Early rounds use wide error thresholds, since the poses are rough. The result is aligned to the
    given cameras by a similarity, so that the world stays the given one.
    """
    poses = given = job.cameras.world_to_camera
    for slack in REFINEMENTS:
        model = _triangulated(job, poses, scratch, slack)
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_extra_params = False
        options.refine_sensor_from_rig = False  # the faces of a photograph lie exactly
        options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        options.ceres.solver_options.num_threads = 1
        options.print_summary = False
        pycolmap.bundle_adjustment(model, options)
        poses = given.copy()
        for number in sorted(model.reg_image_ids()):
            poses[number - 1, :3] = model.images[number].cam_from_world().matrix()
    turns = np.einsum("vji,vjk->vik", given[:, :3, :3], poses[:, :3, :3])
    scale, turn, shift = similarity(camera_centres(poses), camera_centres(given), turns)
    centres = scale * camera_centres(poses) @ turn.T + shift
    poses[:, :3] = poses_of(poses[:, :3, :3] @ turn.T, centres)
    return poses


def _triangulated(
    job: Triangulation, poses: NDArray[np.float64], scratch: Path, slack: float = 1.0
) -> pycolmap.Reconstruction:
    """Triangulate the matches with fixed poses [V, 4, 4]. slack: factor on COLMAP's error
    thresholds."""
    scratch.mkdir()
    project, folder = job.project, job.project.photographs.folder
    model = _posed(project, replace(job.cameras, world_to_camera=poses))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = project.seed
    triangulation = options.triangulation
    triangulation.random_seed = project.seed
    triangulation.create_max_angle_error *= slack
    triangulation.continue_max_angle_error *= slack
    triangulation.merge_max_reproj_error *= slack
    triangulation.complete_max_reproj_error *= slack
    options.mapper.filter_max_reproj_error *= slack
    model = pycolmap.triangulate_points(model, project.database, folder, scratch, options=options)
    model.extract_colors_for_all_images(folder, num_threads=1)
    model.update_point_3d_errors()
    shutil.rmtree(scratch)
    return model


def _posed(project: Project, known: KnownCameras) -> pycolmap.Reconstruction:
    """A model of the views, without points, with the rigs and frames of the database. The camera of
    each view has the id of its image."""
    model = pycolmap.Reconstruction()
    for camera in _cameras(project.photographs.cameras, known.intrinsics):
        model.add_camera(camera)
    frame_of: dict[int, int] = {}
    with pycolmap.Database.open(project.database) as database:
        for rig in database.read_all_rigs():
            model.add_rig(rig)
        for frame in database.read_all_frames():
            frame_of |= {data.id: frame.frame_id for data in frame.data_ids}
            frame.rig_from_world = pycolmap.Rigid3d(known.world_to_camera[frame.rig_id - 1, :3])
            model.add_frame(frame)
    for number, name in enumerate(project.photographs.names, 1):
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        image.frame_id = frame_of[number]
        model.add_image(image)
    for frame_id in sorted(set(frame_of.values())):
        model.register_frame(frame_id)
    return model


def _save_points(model: pycolmap.Reconstruction, poses: NDArray[np.float64], path: Path) -> None:
    arrays = point_arrays(model, {i: i - 1 for i in sorted(model.reg_image_ids())})
    errors = [model.points3D[i].error for i in sorted(model.point3D_ids())]
    np.savez(path, **arrays, errors_px=np.array(errors, np.float64), world_to_camera=poses)  # type: ignore[arg-type]
