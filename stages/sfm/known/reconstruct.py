"""A reconstruction from known cameras: pinhole pictures, poses checked against matches, and points
from the camera file, or from matches with the poses held fixed."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.base.errors import ReconstructionError, SplatError, UsageError
from stages.base.stage import Report
from stages.base.text import counted, listed
from stages.cameras.camera_file import FilePoints
from stages.cameras.camera_formats import read_cameras, read_points
from stages.cameras.colmap import Observations
from stages.scene import Capture, Photo, Reconstruction
from stages.scene.rotations import quaternions_of
from stages.sfm.finish import COLMAP, write_reconstruction
from stages.sfm.known.epipolar import MISFIT_RATIO, PoseCheck
from stages.sfm.known.match_cameras import match_cameras
from stages.sfm.known.pinhole_views import PinholeView, write_pinhole_views
from stages.sfm.known.points import find_points
from stages.sfm.place.levelling import levelling_rotation, up_direction
from stages.sfm.place.metric_scale import KnownScale, find_metric_scale
from stages.sfm.settings import SfmSettings
from stages.sfm.undistorted_images import IMAGES, PosedPhoto, mask_file
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.job import (
    CameraGuess,
    Features,
    KnownCameras,
    Neighbours,
    Photographs,
    Project,
    Sift,
    Triangulation,
    derived_paths,
    prepare_work_folder,
)
from stages.sfm.worker.pairs import Pair
from stages.sfm.worker.process import run_step
from stages.sfm.worker.sparse_model import camera_centres

NEIGHBOURS = 10
_NEXT_IN_ORDER = 2  # photographs, which are matched whatever the poses say
EXHAUSTIVE_UP_TO = 25  # views
_SAME_PART = 1e-6  # difference of the rotations of two faces in the same direction
INLIER_RATIO, ROUGH_INLIER_RATIO = 0.5, 0.5  # of the median pair; rough: at four times the distance
FEWEST_PAIRS = 3
POINTS = "points.npz"  # in the folder that `triangulation` writes


def reconstruct(
    capture: Capture,
    path: Path,
    settings: SfmSettings,
    folder: Path,
    work: Path,
    report: Report,
) -> Reconstruction:
    """The capture with the cameras in `path`. Writes what `finish.finish` writes.

    Args:
        capture: the photographs.
        path: a camera file or folder.
        settings: of the stage.
        folder: of the reconstruction.
        work: folder for what an interrupted run resumes from.
        report: receives metrics, warnings and progress.

    Raises SplatError, and Interrupted.
    """
    deadline = time.monotonic() + 60.0 * settings.max_minutes
    found = read_cameras(path)
    from_file = read_points(path)
    posed = match_cameras(found, capture, settings.split, settings.allow_partial, report)
    _check_usable(posed, settings.refine_cameras)
    shutil.rmtree(folder / COLMAP, ignore_errors=True)
    views = write_pinhole_views(posed, capture.folder, folder, report)
    roles = [posed[view.number].role for view in views]
    training = [i for i, role in enumerate(roles) if role != "test"]
    chosen = [views[i] for i in training]
    project = _project(chosen, folder, work, settings.seed)
    known = _known_cameras(chosen)
    turns = np.array([view.rotation for view in chosen])
    pairs = neighbours(known.world_to_camera, turns, project.photographs.frames)
    out = _match(project, known, tuple(pairs), settings, work, deadline, report)
    check = json.loads((out / "pose_check.json").read_text(encoding="utf-8"))
    sources = (view.photo.source for view in chosen)
    names = dict(zip(project.photographs.frame_of, sources, strict=True))
    _check_poses(PoseCheck(**check), names, settings, report)
    if settings.refine_cameras:
        views = chosen = _refined(views, out / POINTS, report)  # none is for testing
    cameras = [view.camera for view in chosen]
    cloud, observed = find_points(from_file, out / POINTS, cameras, report)
    observed = replace(observed, views=np.array(training, np.int32)[observed.views])
    scale = KnownScale(
        settings.scale, settings.marker, settings.crs, settings.metres, found.georeference
    )
    done = _finish(views, cloud, observed, scale, folder, report)
    with_roles = zip(done.views, roles, strict=True)
    return replace(done, views=tuple(replace(view, role=role) for view, role in with_roles))


def _of_photograph(view: PinholeView) -> NDArray[np.float64]:
    """[4, 4] the pose of the photograph that a view shows a part of."""
    pose = view.camera.world_to_camera.copy()
    pose[:3] = view.rotation.T @ pose[:3]
    return pose


def _project(views: Sequence[PinholeView], folder: Path, work: Path, seed: int) -> Project:
    """The project of the training views, each with a camera of its own. The faces of a photograph
    are a rig."""
    photos = [view.photo for view in views]
    numbers = np.unique([view.number for view in views], return_inverse=True)[1]
    photographs = Photographs(
        folder=(folder / IMAGES).resolve(),
        names=tuple(photo.picture for photo in photos),
        masks=tuple(_mask_from_images(photo) for photo in photos),
        camera_of=tuple(range(len(views))),
        frame_of=tuple(numbers.tolist()),
        cameras=tuple(_guess(view) for view in views),
    )
    return Project(work / "known.db", photographs, seed, threads.count())


def _known_cameras(views: Sequence[PinholeView]) -> KnownCameras:
    cameras = [view.camera for view in views]
    return KnownCameras(
        intrinsics=np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras]),
        world_to_camera=np.array([camera.world_to_camera for camera in cameras]),
    )


def _guess(view: PinholeView) -> CameraGuess:
    camera, face = view.camera, view.photo.face
    rig = (f"{view.number}", tuple(quaternions_of(view.rotation).tolist())) if face else ("", ())
    return CameraGuess(camera.width, camera.height, (camera.fx * camera.fy) ** 0.5, *rig)


def _mask_from_images(photo: Photo) -> str:
    """Path of a photograph's undistorted mask, relative to the undistorted pictures."""
    return os.path.relpath(mask_file(photo), IMAGES) if photo.mask else ""


def neighbours(
    poses: NDArray[np.float64], faces: NDArray[np.float64], photographs: NDArray[np.int64]
) -> list[Pair]:
    """The pairs to match: each view with those nearest in position and direction, and with the
    same part of the photographs next in order, in case the poses are wrong. The views of one
    photograph show different things, and are not matched.

    Args:
        poses: world-to-camera matrices [V, 4, 4].
        faces: [V, 3, 3] from each photograph's axes to the camera's.
        photographs: [V] number of each view's photograph.
    """
    count = len(poses)
    first, second = np.triu_indices(count, 1)
    apart = photographs[first] != photographs[second]
    first, second = first[apart], second[apart]
    if count > EXHAUSTIVE_UP_TO:
        rotations = poses[:, :3, :3]
        centres = camera_centres(poses)
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        angle = np.arccos(np.clip(rotations[:, 2] @ rotations[:, 2].T, -1.0, 1.0))
        cost = distance / max(float(np.median(distance)), 1e-300) + angle
        cost[photographs[:, None] == photographs[None]] = np.inf
        near = np.argsort(cost, axis=1, kind="stable")[:, :NEIGHBOURS]
        selected = np.zeros((count, count), np.bool_)
        np.put_along_axis(selected, near, True, axis=1)
        selected |= selected.T
        alike = np.abs(faces[first] - faces[second]).max(axis=(1, 2)) < _SAME_PART
        following = photographs[second] - photographs[first] <= _NEXT_IN_ORDER
        keep = selected[first, second] | (following & alike)
        first, second = first[keep], second[keep]
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _match(
    project: Project,
    known: KnownCameras,
    pairs: tuple[Pair, ...],
    settings: SfmSettings,
    work: Path,
    deadline: float,
    report: Report,
) -> Path:
    """Features, matches, and the check of poses and points from matches; skips finished steps.
    Returns the folder that the last step writes. deadline: of `time.monotonic`."""
    sift, refine, out = Sift(settings.max_features), settings.refine_cameras, work / "known"
    prepare_work_folder(work, project, sift, known, pairs, refine)
    jobs = (
        Features(project, sift),
        Neighbours(project, known, pairs),
        Triangulation(project, out, known, refine),
    )
    markers = [work / f"{job.step}.done" for job in jobs]
    sqlite.usable(project.database, *markers, *derived_paths(project.database))
    for job, marker in zip(jobs, markers, strict=True):
        if not marker.exists():
            run_step(job, work, report, deadline - time.monotonic())
            marker.touch()
    return out


def _refined(views: Sequence[PinholeView], path: Path, report: Report) -> list[PinholeView]:
    """The views with refined poses; reports by how much they moved."""
    poses = np.load(path)["world_to_camera"]
    cameras = [view.camera for view in views]
    moved = [replace(c, world_to_camera=p) for c, p in zip(cameras, poses, strict=True)]
    away = [float(np.linalg.norm(a.centre - b.centre)) for a, b in zip(moved, cameras, strict=True)]
    before = np.array([camera.world_to_camera for camera in cameras])
    cosines = np.einsum("vij,vij->v", poses[:, :3, :3], before[:, :3, :3]) / 2 - 0.5
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    report.metric("cameras_moved", {"median": float(np.median(away)), "max": max(away)})
    report.metric(
        "cameras_turned_deg", {"median": float(np.median(angles)), "max": float(angles.max())}
    )
    return [replace(view, camera=camera) for view, camera in zip(views, moved, strict=True)]


def _check_poses(
    check: PoseCheck, names: Mapping[int, str], settings: SfmSettings, report: Report
) -> None:
    """Refuse poses that do not fit the matches. names: of the photographs, by number of frame."""
    ratio = check.given
    if settings.refine_cameras:
        report.metric("epipolar_inlier_ratio_before", None if ratio is None else round(ratio, 4))
        ratio = check.refined
    report.metric("matched_pairs", check.pairs)
    report.metric("epipolar_inlier_ratio", None if ratio is None else round(ratio, 4))
    if ratio is None or check.pairs < FEWEST_PAIRS:
        report.warn(
            "cameras-unchecked",
            "Too few photographs match each other to check the cameras: they are used as they are.",
        )
        return
    if ratio >= INLIER_RATIO:
        _warn_misfits(check, names, report)
        return
    if (check.rough or 0.0) >= ROUGH_INLIER_RATIO:
        report.warn(
            "cameras-rough",
            f"Only {ratio:.0%} of the matches lie within 4 px of 1600 of where the cameras predict "
            "them, but most lie within 16 px: the cameras are rough, and the result will be "
            "blurred. --refine-cameras refines their poses.",
        )
        return
    error = ReconstructionError(
        "cameras-do-not-fit",
        given=f"Only {ratio:.0%} of the matches between two photographs fit the file's cameras.",
        wanted=f"At least {INLIER_RATIO:.0%}, as cameras of these photographs have.",
        hint="Check that the file belongs to these photographs, under these names, uncropped, and "
        "follows the axes of its format: camera to world in OpenGL's for a transforms.json. "
        "--allow-partial goes on all the same; with --cameras '' splat finds cameras itself.",
    )
    if not settings.allow_partial:
        raise error
    report.warn(error.code, f"Accepted because of --allow-partial: {error.given}")


def _warn_misfits(check: PoseCheck, names: Mapping[int, str], report: Report) -> None:
    """Name the photographs whose own cameras do not fit, while most others do."""
    if not check.misfits:
        return
    message = (
        f"{len(check.misfits)} of {counted(len(names), 'photograph')} do not fit their cameras: "
        f"{listed([names[frame] for frame in check.misfits])}. Less than {MISFIT_RATIO:.0%} of "
        "their matches lie where the cameras predict them. "
    )
    if check.upside_down:
        turned = listed([names[frame] for frame in check.upside_down])
        message += (
            f"Turned by 180 degrees they would fit: {turned}. A camera is so where EXIF turns a "
            "photograph and the camera is for the pixels as stored: rotate the pixels themselves, "
            "and estimate the cameras again. "
        )
    if len(check.upside_down) < len(check.misfits):
        message += (
            "Check that the cameras were estimated from these photographs. If you remove them, "
            "--allow-partial goes on with the others."
        )
    report.warn("cameras-some-do-not-fit", message.rstrip())


def _finish(
    views: Sequence[PinholeView],
    cloud: FilePoints,
    observations: Observations,
    known_scale: KnownScale,
    folder: Path,
    report: Report,
) -> Reconstruction:
    """Level, recentre and scale; write the COLMAP model."""
    georeference = known_scale.georeference
    turn, levelled = _levelling(views, georeference.axes)
    middle = np.median(np.repeat(cloud.points, np.maximum(cloud.tracks, 1), axis=0), axis=0)
    world_from_new = np.eye(4)
    world_from_new[:3, :3], world_from_new[:3, 3] = turn.T, middle
    cameras = [view.camera.moved(world_from_new) for view in views]
    points = (cloud.points - middle) @ turn.T
    photos = [view.photo for view in views]
    pictures = [folder / IMAGES / photo.picture for photo in photos]
    if georeference.place is not None:
        place = georeference.place.moved(world_from_new)
        known_scale = replace(known_scale, georeference=replace(georeference, place=place))
    scale = find_metric_scale(known_scale, photos, cameras, pictures, levelled, report)
    if scale is not None:
        points, cameras = scale.points(points), scale.cameras(cameras)
        world_from_new[:3, :3] = world_from_new[:3, :3] @ scale.turn.T / scale.metres
    report.metric("file_from_world", world_from_new.tolist())
    done = write_reconstruction(
        folder,
        photos,
        cameras,
        replace(cloud, points=points),
        observations,
        levelled=levelled,
        metric=scale,
    )
    return replace(done, file_from_world=world_from_new)


def _levelling(
    views: Sequence[PinholeView], axes: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], bool]:
    """(rotation [3, 3] to a world with up = -Y, whether up is known): by the axes of the file, with
    +Z to the north, or else by how the photographs were held."""
    if axes is not None:
        east, north, up = axes
        return np.stack([east, -up, north]), True
    photographs = {view.number: _of_photograph(view)[:3, :3] for view in views}
    rotations = np.array([*photographs.values()])
    found = up_direction(rotations)
    if found is None:
        return np.eye(3), False
    return levelling_rotation(found, rotations[0, 2], rotations[0, 0]), True


def _check_usable(posed: Sequence[PosedPhoto], refine: bool) -> None:
    if len(posed) < 3:
        raise SplatError(
            "sfm-too-few-photographs",
            given=f"{counted(len(posed), 'photograph')} of the capture have a camera.",
            wanted="At least 3.",
            hint="Check that the file's names are those of the photographs.",
        )
    training = sum(one.role != "test" for one in posed)
    if training < 2:
        raise SplatError(
            "sfm-too-few-photographs",
            given=f"{counted(training, 'photograph')} of {len(posed)} with a camera "
            f"{'is' if training == 1 else 'are'} for training, by the split of the camera file.",
            wanted="At least 2.",
            hint="Add photographs for training, or leave --split away; then every eighth is held "
            "out.",
        )
    if refine and any(one.role == "test" for one in posed):
        raise UsageError(
            "cameras-split-and-refined",
            given="--refine-cameras with --split: refinement moves the training cameras and not "
            "the test cameras, so the test views would no longer fit.",
            wanted="One of the two options.",
            hint="Leave --split away; then every eighth photograph is held out.",
        )
