"""A reconstruction from cameras that are known: pictures undistorted, poses checked against
matches, points from the file, from matches with the poses held, or at random."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.base.atomic import replacing
from stages.base.errors import Family, Interrupted, SplatError
from stages.base.stage import Report
from stages.base.text import counted
from stages.cameras.camera_file import FilePoints
from stages.cameras.colmap import ColmapModel, write_colmap_model
from stages.cameras.table import read_cameras, read_points
from stages.photos.load import load_mask
from stages.scene import TRANSPARENT, Camera, Capture, Photo, Reconstruction, View
from stages.structure import worker_progress
from stages.structure.attempt_runner import _repair_or_delete as repair_or_delete
from stages.structure.common_view import count_views, random_points
from stages.structure.finish import (
    COLMAP,
    IMAGES,
    SPARSE,
    mask_file,
    read_picture,
    write_mask,
    write_picture,
)
from stages.structure.job import CameraGuess, Job, known_cameras_path
from stages.structure.lenses import maps, straightened
from stages.structure.levelling import levelling_rotation, up_direction
from stages.structure.match_cameras import PosedPhoto, match_cameras
from stages.structure.metric_scale import KnownScale, find_metric_scale
from stages.structure.process import WorkerCrashed, WorkerTimedOut, crash_error, run_worker

NEIGHBOURS = 10
_IN_ORDER = 2  # photographs ahead, also compared, whatever the poses say
EXHAUSTIVE_UP_TO = 25
FITS, ROUGHLY_FITS = 0.5, 0.5  # of the matches of the typical pair
FEWEST_PAIRS = 3
POINTS_PER_VIEW = 20
_SEEN_SHARE = 0.1  # of a file's points, by two cameras at least
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
    size: KnownScale,
    seconds_left: Callable[[], float],
) -> Reconstruction:
    """The capture with the cameras in `path`. Leaves what `finish` leaves, but reconstruction.json.

    split: see `posed_photographs`. refine: let the matches move the cameras. Raises SplatError, and
    Interrupted.
    """
    found = read_cameras(path)
    from_file = read_points(path)
    posed = match_cameras(found, capture, split, allow_partial, report)
    if len(posed) < 3:
        raise _too_few(len(posed))
    shutil.rmtree(folder / COLMAP, ignore_errors=True)
    cameras = _undistorted(posed, capture.folder, folder, report)
    training = [i for i, one in enumerate(posed) if one.role != "test"]
    if refine and len(training) < len(posed):
        raise _judges_cannot_follow()
    job = _job(posed, cameras, training, folder, work, seed, max_features, refine)
    _match(job, work, report, seconds_left)
    _judge(Path(job.out), report, allow_partial)
    if refine:
        cameras = _moved(cameras, Path(job.out) / "points.npz", report)
    seen = [cameras[i] for i in training]
    cloud = _file_points(from_file, seen, report)
    source = "the cameras' file"
    observed = _Observed.none()
    if cloud is None:
        cloud, observed = _triangulated(Path(job.out) / "points.npz", training)
        outside = [_empty_space(folder, posed[i].photo, cameras[i]) for i in training]
        source = "matches"
        if len(cloud.points) < POINTS_PER_VIEW * len(training):
            cloud, source = _with_random(cloud, seen, outside, seed, report), "chance"
    report.metric("points_from", source)
    if found.ground.metres and not size.stated:
        size = replace(size, stated=found.ground.metres, stated_by=found.ground.said_by)
    axes = found.ground.axes
    return _finished(posed, cameras, cloud, observed, folder, report, size, capture, axes)


def _undistorted(
    posed: list[PosedPhoto], source: Path, folder: Path, report: Report
) -> list[Camera]:
    """The pinhole camera of each photograph, whose picture is written. A photograph that is
    straight already stays as it is, byte for byte."""
    cameras, kept = [], []
    known: dict[tuple[object, ...], tuple[Camera, float]] = {}
    for done, one in enumerate(posed):
        if report.stop_requested.is_set():
            raise Interrupted
        report.progress(done, len(posed), "undistorting", photographs=done)
        c = one.camera
        key = (one.lens, c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        if key not in known:
            known[key] = straightened(c, one.lens)
        pinhole, share = known[key]
        cameras.append(replace(pinhole, world_to_camera=c.world_to_camera))
        kept.append(share)
        target = folder / IMAGES / one.photo.picture
        target.parent.mkdir(parents=True, exist_ok=True)
        if one.lens.bends:
            image = read_picture(source / one.photo.image)
            x, y = maps(c, one.lens, pinhole)
            write_picture(
                target,
                cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE),
            )
            write_mask(one.photo, source, folder, (x, y))
        else:
            read_picture(source / one.photo.image)  # raises if it is gone
            with replacing(target) as partial:
                shutil.copyfile(source / one.photo.image, partial)
            write_mask(one.photo, source, folder, None)
    lost = 1.0 - float(np.mean(kept))
    report.metric("lost_by_undistortion", round(lost, 4))
    if lost > _LOST_SHARE:
        report.warn(
            "sfm-edges-lost",
            f"The lens bends so much that {lost:.0%} of the photographs' area, at their edges, "
            "has no place in straight pictures and is not used.",
        )
    return cameras


def _job(
    posed: list[PosedPhoto],
    cameras: list[Camera],
    training: list[int],
    folder: Path,
    work: Path,
    seed: int,
    max_features: int,
    refine: bool,
) -> Job:
    """Of the training photographs alone, undistorted, each with a camera of its own. What an
    interrupted run left is kept if it was about the same."""
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
        names=tuple(posed[i].photo.picture for i in training),
        masks=tuple(_from_images(posed[i].photo) for i in training),
        camera_of=tuple(range(len(training))),
        cameras=tuple(CameraGuess(c.width, c.height, (c.fx * c.fy) ** 0.5) for c in chosen),
        seed=seed,
        threads=threads.count(),
        max_features=max_features,
        refine=refine,
    )
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(v).tobytes() for v in known.values()))
    about = json.dumps([job.names, seed, max_features, refine, digest.hexdigest()])
    described = work / "known.json"
    if not described.is_file() or described.read_text(encoding="utf-8") != about:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        described.write_text(about, encoding="utf-8")
    np.savez(known_cameras_path(job), **known)  # type: ignore[arg-type]
    return job


def _from_images(photo: Photo) -> str:
    """A photograph's mask as seen from the undistorted pictures."""
    return os.path.relpath(mask_file(photo), IMAGES) if photo.mask else ""


def neighbours(poses: NDArray[np.float64]) -> NDArray[np.int32]:
    """[Q, 2] pairs to compare, of world-to-camera matrices [V, 4, 4]: each with those that stand
    nearest and look the same way, and with the next in order, in case the poses are wrong."""
    count = len(poses)
    first, second = np.triu_indices(count, 1)
    if count > EXHAUSTIVE_UP_TO:
        rotations = poses[:, :3, :3]
        centres = -np.einsum("vij,vi->vj", rotations, poses[:, :3, 3])
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        turned = np.arccos(np.clip(rotations[:, 2] @ rotations[:, 2].T, -1.0, 1.0))
        cost = apart / max(float(np.median(apart)), 1e-300) + turned
        np.fill_diagonal(cost, np.inf)
        near = np.argsort(cost, axis=1, kind="stable")[:, :NEIGHBOURS]
        wanted = np.zeros((count, count), np.bool_)
        np.put_along_axis(wanted, near, True, axis=1)
        wanted |= wanted.T
        keep = wanted[first, second] | (second - first <= _IN_ORDER)
        first, second = first[keep], second[keep]
    return np.stack([first, second], axis=1).astype(np.int32)


def _match(job: Job, work: Path, report: Report, seconds_left: Callable[[], float]) -> None:
    """Features, matches, agreement and points of the job, each step unless it is done."""
    database = Path(job.database)
    steps = (
        "features",
        "neighbours",
        "triangulation",
    )
    try:
        for step in steps:
            marker = work / f"{step}.done"
            if marker.exists():
                continue
            if database.exists():
                repair_or_delete(database)

            Path(job.progress).unlink(missing_ok=True)

            def tick() -> None:
                told = worker_progress.read_progress(Path(job.progress))
                if told is not None:
                    phase, done, total = told
                    report.progress(done, total, phase)

            run_worker(replace(job, step=step), work, report.stop_requested, seconds_left(), tick)
            marker.touch()
    except WorkerTimedOut:
        raise _timed_out() from None
    except WorkerCrashed as crash:
        raise crash_error(crash, work) from crash


def _moved(cameras: list[Camera], path: Path, report: Report) -> list[Camera]:
    """The cameras where the matches want them; how far that is into the report."""
    poses = np.load(path)["world_to_camera"]
    moved = [replace(c, world_to_camera=p) for c, p in zip(cameras, poses, strict=True)]
    away = [float(np.linalg.norm(a.centre - b.centre)) for a, b in zip(moved, cameras, strict=True)]
    before = np.array([camera.world_to_camera for camera in cameras])
    cosines = np.einsum("vij,vij->v", poses[:, :3, :3], before[:, :3, :3]) / 2 - 0.5
    turns = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    report.metric("cameras_moved", {"centre": float(np.median(away)), "most": max(away)})
    report.metric(
        "cameras_turned_deg", {"median": float(np.median(turns)), "most": float(turns.max())}
    )
    return moved


def _judge(out: Path, report: Report, allow_partial: bool) -> None:
    """Refuse poses that do not fit the matches, with the likely cause."""
    found = json.loads((out / "agreement.json").read_text(encoding="utf-8"))
    given, roughly = found["given"], found["roughly"]
    if "refined" in found:
        report.metric("matches_that_fitted_before", None if given is None else round(given, 4))
        given = found["refined"]
    report.metric("matched_pairs", found["pairs"])
    report.metric("matches_that_fit", None if given is None else round(given, 4))
    if given is None or found["pairs"] < FEWEST_PAIRS:
        report.warn(
            "cameras-unchecked",
            "Too few photographs show the same recognisable spots to check the cameras by: they "
            "are taken as they are.",
        )
        return
    if given >= FITS:
        return
    name, best = max(found["others"].items(), key=lambda other: other[1] or 0.0)
    if (best or 0.0) < FITS and roughly >= ROUGHLY_FITS:
        report.warn(
            "cameras-rough",
            f"Only {given:.0%} of what photographs have in common lies where the cameras want it "
            "to within 4 px of 1600, but most of it nearby: the cameras are rough, and the result "
            "will be blurred. --refine-cameras moves them to where the matches want them.",
        )
        return
    likely = (
        f"The pictures agree ({best:.0%}) if {name}"
        if (best or 0.0) >= FITS
        else ("Check that the file belongs to these photographs, under these names, uncropped.")
    )
    error = SplatError(
        "cameras-do-not-fit",
        given=f"Only {given:.0%} of what two photographs have in common lies where the file's "
        "cameras want it.",
        wanted=f"At least {FITS:.0%}, as cameras of these photographs have.",
        hint=f"{likely} --allow-partial goes on all the same; without --cameras, splat finds "
        "cameras itself.",
        family=Family.RECONSTRUCTION,
    )
    if not allow_partial:
        raise error
    report.warn(error.code, f"Accepted all the same: {error.given} {likely}")


class _Observed:
    """Which points each view sees, and where; sorted by point, then view."""

    def __init__(
        self, points: NDArray[np.int32], views: NDArray[np.int32], px: NDArray[np.float64]
    ) -> None:
        self.points, self.views, self.px = points, views, px

    @classmethod
    def none(cls) -> _Observed:
        return cls(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)))


def _file_points(
    found: FilePoints | None, cameras: list[Camera], report: Report
) -> FilePoints | None:
    """The file's points if they lie where its cameras look."""
    if found is None or not len(found.points):
        return None
    seen = count_views(cameras, found.points)
    if (seen >= 2).mean() < _SEEN_SHARE:
        report.warn(
            "cameras-points-elsewhere",
            f"Only {np.mean(seen >= 2):.0%} of the file's {counted(len(seen), 'point')} lie before "
            "two of its cameras: they are not used. Do they belong to another world or scale?",
        )
        return None
    tracks = np.where(found.tracks > 0, found.tracks, seen).astype(np.int32)
    return replace(found, tracks=tracks)


def _triangulated(path: Path, training: list[int]) -> tuple[FilePoints, _Observed]:
    data = np.load(path)
    views = np.array(training, np.int32)[data["observing_views"]]
    seen = _Observed(data["observed_points"], views, data["observed_px"])
    pairs = np.unique(np.stack([seen.points, seen.views], axis=1), axis=0)
    tracks = np.bincount(pairs[:, 0], minlength=len(data["points"])).astype(np.int32)
    return FilePoints(data["points"], data["colours"], data["errors_px"], tracks), seen


def _empty_space(folder: Path, photo: Photo, camera: Camera) -> NDArray[np.bool_] | None:
    """[H, W] where a photograph that is cut out shows that nothing is; None for any other."""
    if photo.outside != TRANSPARENT:
        return None
    mask = load_mask(folder / mask_file(photo), camera.width, camera.height, photo.outside)
    return np.asarray(mask == 0)


def _with_random(
    cloud: FilePoints,
    cameras: list[Camera],
    outside: list[NDArray[np.bool_] | None],
    seed: int,
    report: Report,
) -> FilePoints:
    """More points where the cameras look together, and none shows that nothing is (`outside`):
    matches gave too few."""
    points, centre, radius = random_points(cameras, seed, outside)
    at = ", ".join(f"{value:.3g}" for value in centre)
    report.warn(
        "cameras-random-start",
        f"Matches give only {counted(len(cloud.points), 'point')}: training starts from "
        f"{len(points):,} more at random, within {radius:.3g} of ({at}) in the file's units.",
    )
    grey = np.random.default_rng(seed).integers(0, 256, (len(points), 3)).astype(np.uint8)
    return FilePoints(
        np.concatenate([cloud.points, points]),
        np.concatenate([cloud.colours, grey]),
        np.concatenate([cloud.errors_px, np.zeros(len(points))]),
        np.concatenate([cloud.tracks, count_views(cameras, points)]),
    )


def _judges_cannot_follow() -> SplatError:
    return SplatError(
        "cameras-split-and-refined",
        given="--refine-cameras with --split: test photographs have no part in refinement, and "
        "would judge from where their cameras no longer are.",
        wanted="One of the two.",
        hint="Leave --split away, and every eighth photograph judges.",
        family=Family.USAGE,
    )


def _finished(
    posed: list[PosedPhoto],
    cameras: list[Camera],
    cloud: FilePoints,
    observed: _Observed,
    folder: Path,
    report: Report,
    size: KnownScale,
    capture: Capture,
    axes: NDArray[np.float64] | None,
) -> Reconstruction:
    """Levelled, recentred and measured; the COLMAP model is written. axes: as in `Ground`."""
    turn, levelled = _levelling(cameras, axes)
    middle = np.median(np.repeat(cloud.points, np.maximum(cloud.tracks, 1), axis=0), axis=0)
    world_from_new = np.eye(4)
    world_from_new[:3, :3], world_from_new[:3, 3] = turn.T, middle
    cameras = [camera.moved(world_from_new) for camera in cameras]
    points = (cloud.points - middle) @ turn.T
    names = [one.photo.name for one in posed]
    places = [folder / IMAGES / one.photo.picture for one in posed]
    metric = find_metric_scale(size, capture, names, cameras, places, levelled, report)
    if metric is not None:
        poses = np.array([camera.world_to_camera for camera in cameras])
        points, poses = metric.points(points), metric.poses(poses)
        cameras = [
            replace(camera, world_to_camera=pose)
            for camera, pose in zip(cameras, poses, strict=True)
        ]
        world_from_new[:3, :3] = world_from_new[:3, :3] @ metric.turn.T / metric.metres
    pictures = [one.photo.picture for one in posed]
    write_colmap_model(
        folder / SPARSE,
        ColmapModel(
            names=tuple(pictures),
            cameras=tuple(cameras),
            points=points,
            colours=cloud.colours,
            errors_px=cloud.errors_px,
            observed_points=observed.points,
            observing_views=observed.views,
            observed_px=observed.px,
        ),
    )
    report.metric("file_from_world", world_from_new.tolist())
    return Reconstruction(
        folder=folder,
        views=tuple(
            View(
                one.photo.name,
                f"{IMAGES}/{picture}",
                camera,
                one.photo.duplicate_of,
                one.role,
                mask_file(one.photo),
                one.photo.outside,
            )
            for one, picture, camera in zip(posed, pictures, cameras, strict=True)
        ),
        points=points,
        colours=cloud.colours,
        errors_px=cloud.errors_px,
        tracks=cloud.tracks,
        levelled=levelled,
        units="arbitrary" if metric is None else "metres",
    )


def _levelling(
    cameras: list[Camera], axes: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], bool]:
    """(rotation [3, 3] to a world whose y points down, whether anything says where that is): by the
    file, then +Z is north; else by how the cameras were held."""
    if axes is not None:
        east, north, up = axes
        return np.stack([east, -up, north]), True
    rotations = np.array([camera.world_to_camera[:3, :3] for camera in cameras])
    found = up_direction(rotations)
    if found is None:
        return np.eye(3), False
    return levelling_rotation(found, rotations[0, 2], rotations[0, 0]), True


def _too_few(count: int) -> SplatError:
    return SplatError(
        "sfm-too-few-photographs",
        given=f"{counted(count, 'photograph')} of the capture have a camera.",
        wanted="At least 3.",
        hint="Check that the file's names are those of the photographs.",
    )


def _timed_out() -> SplatError:
    return SplatError(
        "sfm-timed-out",
        given="Features and matches of the photographs were not ready in time.",
        wanted="The cameras are checked against matches before they are used.",
        hint="Allow more time with --max-minutes, or use fewer or smaller photographs.",
        family=Family.RECONSTRUCTION,
    )
