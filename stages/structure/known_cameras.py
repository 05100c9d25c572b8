"""A reconstruction from known cameras: pictures undistorted, poses checked against matches, points
from the camera file, from matches with the poses held fixed, or at random."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.base.text import counted
from stages.cameras.camera_file import FilePoints
from stages.cameras.table import read_cameras, read_points
from stages.scene import Camera, Capture, Photo, Reconstruction
from stages.structure import database as sqlite
from stages.structure.finish import COLMAP, Observations, write_reconstruction
from stages.structure.job import CameraGuess, Job, known_cameras_path, prepare_work_folder
from stages.structure.known_points import find_points
from stages.structure.levelling import levelling_rotation, up_direction
from stages.structure.match_cameras import PosedPhoto, match_cameras
from stages.structure.metric_scale import KnownScale, find_metric_scale
from stages.structure.process import run_step
from stages.structure.sparse_model import camera_centres
from stages.structure.undistorted_images import IMAGES, mask_file, write_undistorted_images

NEIGHBOURS = 10
_NEXT_IN_ORDER = 2  # photographs, which are matched whatever the poses say
EXHAUSTIVE_UP_TO = 25  # photographs
INLIER_RATIO, ROUGH_INLIER_RATIO = 0.5, 0.5  # of the median pair; rough: at four times the distance
FEWEST_PAIRS = 3
_LOST_SHARE = 0.02


def reconstruct(
    capture: Capture,
    path: Path,
    folder: Path,
    work: Path,
    report: Report,
    *,
    split: bool,
    refine: bool,
    allow_partial: bool,
    seed: int,
    max_features: int,
    known_scale: KnownScale,
    seconds_left: Callable[[], float],
) -> Reconstruction:
    """The capture with the cameras in `path`. Writes what `finish.finish` writes.

    Args:
        capture: the photographs.
        path: a camera file or folder.
        folder: of the reconstruction.
        work: folder for what an interrupted run resumes from.
        report: receives metrics, warnings and progress.
        split: see `match_cameras`.
        refine: refine the poses by bundle adjustment.
        allow_partial: accept missing cameras and poses that do not fit the matches.
        seed, max_features: of features and matching.
        known_scale: what is known of the size of the scene.
        seconds_left: until the deadline.

    Raises SplatError, and Interrupted.
    """
    found = read_cameras(path)
    from_file = read_points(path)
    posed = match_cameras(found, capture, split, allow_partial, report)
    _check_usable(posed, refine)
    shutil.rmtree(folder / COLMAP, ignore_errors=True)
    photos, taken, lenses = zip(*((p.photo, p.camera, p.lens) for p in posed), strict=True)
    cameras, share = write_undistorted_images(photos, taken, lenses, capture.folder, folder, report)
    _report_lost_area(1.0 - share, report)
    training = [i for i, one in enumerate(posed) if one.role != "test"]
    job = _job(photos, cameras, training, folder, work, seed, max_features, refine)
    _match(job, work, report, seconds_left)
    triangulated = Path(job.out) / "points.npz"
    _check_poses(Path(job.out), report, allow_partial)
    if refine:
        cameras = _refined(cameras, triangulated, report)
    cloud, observations = find_points(
        from_file, triangulated, training, photos, cameras, folder, seed, report
    )
    georeference = found.georeference
    if georeference.metres_per_unit and not known_scale.metres_per_unit:
        known_scale = replace(
            known_scale,
            metres_per_unit=georeference.metres_per_unit,
            source=georeference.source,
        )
    known_scale = replace(known_scale, place=georeference.place)
    axes = georeference.axes
    return _finish(posed, cameras, cloud, observations, folder, report, known_scale, axes)


def _report_lost_area(lost: float, report: Report) -> None:
    report.metric("area_lost_by_undistortion", round(lost, 4))
    if lost > _LOST_SHARE:
        report.warn(
            "sfm-edges-lost",
            f"The lens distortion is so strong that {lost:.0%} of the photographs' area, at their "
            "edges, is outside the undistorted pictures and is not used.",
        )


def _job(
    photos: Sequence[Photo],
    cameras: Sequence[Camera],
    training: Sequence[int],
    folder: Path,
    work: Path,
    seed: int,
    max_features: int,
    refine: bool,
) -> Job:
    """The job for the undistorted training photographs, each with a camera of its own."""
    chosen = [cameras[i] for i in training]
    known = {
        "intrinsics": np.array([(c.fx, c.fy, c.cx, c.cy) for c in chosen]),
        "sizes": np.array([(c.width, c.height) for c in chosen], np.int32),
        "world_to_camera": np.array([c.world_to_camera for c in chosen]),
    }
    known["pairs"] = neighbours(known["world_to_camera"])
    job = Job(
        step="",
        images_root=str((folder / IMAGES).resolve()),
        database=str(work / "known.db"),
        out=str(work / "known"),
        progress=str(work / "progress.json"),
        names=tuple(photos[i].picture for i in training),
        masks=tuple(_mask_from_images(photos[i]) for i in training),
        camera_of=tuple(range(len(training))),
        cameras=tuple(CameraGuess(c.width, c.height, (c.fx * c.fy) ** 0.5) for c in chosen),
        seed=seed,
        threads=threads.count(),
        max_features=max_features,
        refine=refine,
    )
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(v).tobytes() for v in known.values()))
    prepare_work_folder(work, job, digest.hexdigest())
    np.savez(known_cameras_path(job), **known)  # type: ignore[arg-type]
    return job


def _mask_from_images(photo: Photo) -> str:
    """Path of a photograph's undistorted mask, relative to the undistorted pictures."""
    return os.path.relpath(mask_file(photo), IMAGES) if photo.mask else ""


def neighbours(poses: NDArray[np.float64]) -> NDArray[np.int32]:
    """[Q, 2] pairs to match, of world-to-camera matrices [V, 4, 4]: each camera with those nearest
    in position and direction, and with the next in order, in case the poses are wrong."""
    count = len(poses)
    first, second = np.triu_indices(count, 1)
    if count > EXHAUSTIVE_UP_TO:
        rotations = poses[:, :3, :3]
        centres = camera_centres(poses)
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        angle = np.arccos(np.clip(rotations[:, 2] @ rotations[:, 2].T, -1.0, 1.0))
        cost = distance / max(float(np.median(distance)), 1e-300) + angle
        np.fill_diagonal(cost, np.inf)
        near = np.argsort(cost, axis=1, kind="stable")[:, :NEIGHBOURS]
        selected = np.zeros((count, count), np.bool_)
        np.put_along_axis(selected, near, True, axis=1)
        selected |= selected.T
        keep = selected[first, second] | (second - first <= _NEXT_IN_ORDER)
        first, second = first[keep], second[keep]
    return np.stack([first, second], axis=1).astype(np.int32)


def _match(job: Job, work: Path, report: Report, seconds_left: Callable[[], float]) -> None:
    """Features, matches, and the check of poses and points from matches; skips finished steps."""
    for step in ("features", "neighbours", "triangulation"):
        marker = work / f"{step}.done"
        if not marker.exists():
            sqlite.repair_or_delete(Path(job.database))
            run_step(replace(job, step=step), work, report, seconds_left())
            marker.touch()


def _refined(cameras: Sequence[Camera], path: Path, report: Report) -> list[Camera]:
    """The cameras with refined poses; reports by how much they moved."""
    poses = np.load(path)["world_to_camera"]
    moved = [replace(c, world_to_camera=p) for c, p in zip(cameras, poses, strict=True)]
    away = [float(np.linalg.norm(a.centre - b.centre)) for a, b in zip(moved, cameras, strict=True)]
    before = np.array([camera.world_to_camera for camera in cameras])
    cosines = np.einsum("vij,vij->v", poses[:, :3, :3], before[:, :3, :3]) / 2 - 0.5
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    report.metric("cameras_moved", {"median": float(np.median(away)), "max": max(away)})
    report.metric(
        "cameras_turned_deg", {"median": float(np.median(angles)), "max": float(angles.max())}
    )
    return moved


def _check_poses(out: Path, report: Report, allow_partial: bool) -> None:
    """Refuse poses that do not fit the matches, and name the likely cause."""
    found = json.loads((out / "pose_check.json").read_text(encoding="utf-8"))
    ratio = found["given"]
    if "refined" in found:
        report.metric("epipolar_inlier_ratio_before", None if ratio is None else round(ratio, 4))
        ratio = found["refined"]
    report.metric("matched_pairs", found["pairs"])
    report.metric("epipolar_inlier_ratio", None if ratio is None else round(ratio, 4))
    if ratio is None or found["pairs"] < FEWEST_PAIRS:
        report.warn(
            "cameras-unchecked",
            "Too few photographs match each other to check the cameras: they are used as they are.",
        )
        return
    if ratio >= INLIER_RATIO:
        return
    mistake, best = max(found["mistakes"].items(), key=lambda other: other[1] or 0.0)
    explained = (best or 0.0) >= INLIER_RATIO
    if not explained and found["rough"] >= ROUGH_INLIER_RATIO:
        report.warn(
            "cameras-rough",
            f"Only {ratio:.0%} of the matches lie within 4 px of 1600 of where the cameras predict "
            "them, but most lie within 16 px: the cameras are rough, and the result will be "
            "blurred. --refine-cameras refines their poses.",
        )
        return
    likely = (
        f"The matches fit ({best:.0%}) if {mistake}"
        if explained
        else "Check that the file belongs to these photographs, under these names, uncropped."
    )
    error = SplatError(
        "cameras-do-not-fit",
        given=f"Only {ratio:.0%} of the matches between two photographs fit the file's cameras.",
        wanted=f"At least {INLIER_RATIO:.0%}, as cameras of these photographs have.",
        hint=f"{likely} --allow-partial goes on all the same; without --cameras, splat finds "
        "cameras itself.",
        family=Family.RECONSTRUCTION,
    )
    if not allow_partial:
        raise error
    report.warn(error.code, f"Accepted because of --allow-partial: {error.given} {likely}")


def _finish(
    posed: Sequence[PosedPhoto],
    cameras: Sequence[Camera],
    cloud: FilePoints,
    observations: Observations,
    folder: Path,
    report: Report,
    known_scale: KnownScale,
    axes: NDArray[np.float64] | None,
) -> Reconstruction:
    """Level, recentre and scale; write the COLMAP model. axes: as in `Georeference`."""
    turn, levelled = _levelling(cameras, axes)
    middle = np.median(np.repeat(cloud.points, np.maximum(cloud.tracks, 1), axis=0), axis=0)
    world_from_new = np.eye(4)
    world_from_new[:3, :3], world_from_new[:3, 3] = turn.T, middle
    cameras = [camera.moved(world_from_new) for camera in cameras]
    points = (cloud.points - middle) @ turn.T
    photos = [one.photo for one in posed]
    pictures = [folder / IMAGES / photo.picture for photo in photos]
    if known_scale.place is not None:
        known_scale = replace(known_scale, place=known_scale.place.moved(world_from_new))
    scale = find_metric_scale(known_scale, photos, cameras, pictures, levelled, report)
    if scale is not None:
        points, cameras = scale.points(points), scale.cameras(cameras)
        world_from_new[:3, :3] = world_from_new[:3, :3] @ scale.turn.T / scale.metres
    report.metric("file_from_world", world_from_new.tolist())
    return write_reconstruction(
        folder,
        photos,
        cameras,
        replace(cloud, points=points),
        observations,
        levelled=levelled,
        metric=scale,
        roles=[one.role for one in posed],
    )


def _levelling(
    cameras: Sequence[Camera], axes: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], bool]:
    """(rotation [3, 3] to a world with up = -Y, whether up is known): by the axes of the file, with
    +Z to the north, or else by how the cameras were held."""
    if axes is not None:
        east, north, up = axes
        return np.stack([east, -up, north]), True
    rotations = np.array([camera.world_to_camera[:3, :3] for camera in cameras])
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
    if refine and any(one.role == "test" for one in posed):
        raise SplatError(
            "cameras-split-and-refined",
            given="--refine-cameras with --split: refinement moves the training cameras and not "
            "the test cameras, so the test views would no longer fit.",
            wanted="One of the two options.",
            hint="Leave --split away; then every eighth photograph is held out.",
            family=Family.USAGE,
        )
