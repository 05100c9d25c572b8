"""From an accepted sparse model to what later stages and other programs read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stages.base.atomic import replacing
from stages.base.errors import Interrupted, SplatError
from stages.base.stage import Report
from stages.cameras.colmap import ColmapModel, write_colmap_model
from stages.scene import TRANSPARENT, Camera, Capture, Photo, Reconstruction, View
from stages.structure.levelling import level_and_recentre
from stages.structure.metric_scale import UNKNOWN_SCALE, KnownScale, find_metric_scale
from stages.structure.sparse_model import SparseModel, point_errors
from stages.structure.undistortion import Pinhole, maps, pinhole_for, undistorted_px

COLMAP = "colmap"
IMAGES = f"{COLMAP}/images"
MASKS = f"{COLMAP}/masks"
SPARSE = f"{COLMAP}/sparse/0"
_JPEG = (
    *(cv2.IMWRITE_JPEG_QUALITY, 97),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)


def finish(
    model: SparseModel,
    capture: Capture,
    folder: Path,
    report: Report,
    known: KnownScale = UNKNOWN_SCALE,
) -> Reconstruction:
    """Level, recentre and measure `model`, write undistorted pictures and a COLMAP model of them,
    and return the reconstruction (not stored yet: see `reconstruction_files`). known: of its size.

    Raises Interrupted, and SplatError "sfm-photo-unreadable" if a photograph has gone.
    """
    shutil.rmtree(folder / COLMAP, ignore_errors=True)  # of an interrupted run, perhaps of others
    model, levelled = level_and_recentre(model)
    photos = {photo.image: photo for photo in capture.photos}
    ordered = [photos[name] for name in model.names]
    pinholes = [
        pinhole_for(size, params)
        for size, params in zip(model.camera_sizes, model.camera_params, strict=True)
    ]
    pictures = [photo.picture for photo in ordered]
    _write_pictures(model, pinholes, ordered, pictures, capture.folder, folder, report)
    cameras = _cameras(model, pinholes)
    names = [photo.name for photo in ordered]
    places = [folder / IMAGES / picture for picture in pictures]
    metric = find_metric_scale(known, capture, names, cameras, places, levelled, report)
    if metric is not None:
        poses, points = metric.poses(model.world_to_camera), metric.points(model.points)
        model = replace(model, world_to_camera=poses, points=points)
        cameras = _cameras(model, pinholes)
    errors = point_errors(model)
    _write_model(model, pinholes, cameras, pictures, errors, folder)
    return Reconstruction(
        folder=folder,
        views=tuple(
            View(
                photo.name,
                f"{IMAGES}/{picture}",
                camera,
                photo.duplicate_of,
                mask=mask_file(photo),
                outside=photo.outside,
            )
            for photo, picture, camera in zip(ordered, pictures, cameras, strict=True)
        ),
        points=model.points,
        colours=model.colours,
        errors_px=errors,
        tracks=model.tracks,
        levelled=levelled,
        units="arbitrary" if metric is None else "metres",
    )


def _cameras(model: SparseModel, pinholes: list[Pinhole]) -> list[Camera]:
    return [
        _camera(pinholes[number], pose)
        for number, pose in zip(model.view_cameras, model.world_to_camera, strict=True)
    ]


def _camera(pinhole: Pinhole, world_to_camera: np.ndarray) -> Camera:
    return Camera(
        width=pinhole.width,
        height=pinhole.height,
        fx=pinhole.focal,
        fy=pinhole.focal,
        cx=pinhole.cx,
        cy=pinhole.cy,
        world_to_camera=world_to_camera,
    )


def _write_pictures(
    model: SparseModel,
    pinholes: list[Pinhole],
    photos: list[Photo],
    pictures: list[str],
    source: Path,
    folder: Path,
    report: Report,
) -> None:
    made: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for done, (photo, picture) in enumerate(zip(photos, pictures, strict=True)):
        if report.stop_requested.is_set():
            raise Interrupted
        report.progress(done, len(photos), "undistorting", photographs=done)
        target = folder / IMAGES / picture
        camera = int(model.view_cameras[done])
        if camera not in made:
            made = {camera: maps(pinholes[camera], model.camera_params[camera])}
        image = cv2.remap(
            read_picture(source / photo.image),
            *made[camera],
            interpolation=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
        target.parent.mkdir(parents=True, exist_ok=True)
        write_picture(target, image)
        write_mask(photo, source, folder, made[camera])
    report.progress(len(photos), len(photos), "undistorting", photographs=len(photos))


def mask_file(photo: Photo) -> str:
    """Of a photograph's undistorted mask, relative to the reconstruction; "" without one."""
    return f"{MASKS}/{photo.picture}.png" if photo.mask else ""


def write_mask(
    photo: Photo, source: Path, folder: Path, maps: tuple[np.ndarray, np.ndarray] | None
) -> None:
    """A photograph's mask, undistorted by `maps` as its picture is, if it has one."""
    if not photo.mask:
        return
    mask = read_picture(source / photo.mask)[..., 0]
    if maps is not None:
        soft = cv2.INTER_LINEAR if photo.outside == TRANSPARENT else cv2.INTER_NEAREST
        mask = cv2.remap(mask, *maps, interpolation=soft, borderMode=cv2.BORDER_REPLICATE)
    target = folder / mask_file(photo)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, mask)


def read_picture(path: Path) -> np.ndarray:
    try:
        data = np.fromfile(path, np.uint8)  # cv2.imread fails on some paths under Windows
    except OSError:
        data = np.empty(0, np.uint8)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise SplatError(
            "sfm-photo-unreadable",
            given=f"{path} cannot be read any more.",
            wanted="The pictures that ingest wrote must stay as they are.",
            hint="Run `splat ingest` again.",
        )
    return image


def write_picture(path: Path, image: np.ndarray) -> None:
    """As the suffix says: what came without loss goes on without."""
    if path.suffix.lower() == ".png":
        encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1]
    else:
        encoded = cv2.imencode(".jpg", image, _JPEG)[1]
    with replacing(path) as partial:
        encoded.tofile(partial)


def _write_model(
    model: SparseModel,
    pinholes: list[Pinhole],
    cameras: list[Camera],
    pictures: list[str],
    errors: np.ndarray,
    folder: Path,
) -> None:
    observed = np.empty_like(model.observed_px)
    camera_of = model.view_cameras[model.observing_views]
    for number, pinhole in enumerate(pinholes):
        mine = camera_of == number
        observed[mine] = undistorted_px(
            model.observed_px[mine], model.camera_params[number], pinhole
        )
    write_colmap_model(
        folder / SPARSE,
        ColmapModel(
            names=tuple(pictures),
            cameras=tuple(cameras),
            points=model.points,
            colours=model.colours,
            errors_px=errors,
            observed_points=model.observed_points,
            observing_views=model.observing_views,
            observed_px=observed,
        ),
    )
