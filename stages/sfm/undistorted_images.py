"""Undistorted pictures, masks and depth maps of a reconstruction, as files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stages.base.atomic import replacing
from stages.base.errors import Interrupted, SplatError
from stages.base.stage import Report
from stages.cameras.lens import Lens
from stages.cameras.undistortion import (
    remap_tables,
    undistorted_camera,
    visible_share,
)
from stages.ingest.write import write_depth
from stages.scene import TRANSPARENT, Camera, Photo
from stages.scene.pictures import load_depth

IMAGES = "colmap/images"
MASKS = "colmap/masks"
DEPTH = "colmap/depth"
_JPEG = (
    *(cv2.IMWRITE_JPEG_QUALITY, 97),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)

_Tables = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class PosedPhoto:
    """A photograph, its camera in pixels of the photograph, its lens and its role in the split of a
    benchmark."""

    photo: Photo
    camera: Camera
    lens: Lens
    role: str = ""

    @property
    def optics(self) -> tuple[object, ...]:
        """Lens, size and intrinsics: equal for photographs that are undistorted in the same way."""
        c = self.camera
        return self.lens, c.width, c.height, c.fx, c.fy, c.cx, c.cy


def mask_file(photo: Photo) -> str:
    """Path of a photograph's undistorted mask in the reconstruction; "" without one."""
    return f"{MASKS}/{photo.picture}.png" if photo.mask else ""


def depth_file(photo: Photo) -> str:
    """Path of a photograph's undistorted depth map in the reconstruction; "" without one."""
    return f"{DEPTH}/{photo.picture}.npy" if photo.depth else ""


def write_undistorted_images(
    posed: Sequence[PosedPhoto], source: Path, folder: Path, report: Report
) -> tuple[list[Camera], float]:
    """Write undistorted pictures, masks and depth maps. A photograph without distortion is copied
    unchanged.

    Args:
        posed: V photographs.
        source: the folder of the capture.
        folder: the folder of the reconstruction.
        report: receives progress.

    Returns:
        The pinhole cameras [V] and the mean share of the photographs that their pictures show.

    Raises Interrupted, and SplatError "sfm-photo-unreadable".
    """
    pinholes, shares = [], []
    known: dict[tuple[object, ...], tuple[Camera, float]] = {}
    tables: dict[tuple[object, ...], _Tables] = {}  # of the last camera: they are large
    for done, taken in enumerate(posed):
        if report.stop_requested.is_set():
            raise Interrupted
        report.progress(done, len(posed), "undistorting", photographs=done)
        photo, camera, lens, key = taken.photo, taken.camera, taken.lens, taken.optics
        if key not in known:
            pinhole = undistorted_camera(camera, lens)
            known[key] = pinhole, visible_share(camera, lens, pinhole)
        pinhole, share = known[key]
        pinholes.append(replace(pinhole, world_to_camera=camera.world_to_camera))
        shares.append(share)
        if lens.distorts and key not in tables:
            tables = {key: remap_tables(camera, lens, pinhole)}
        _write_picture(photo, source, folder, tables.get(key))
        _write_mask(photo, source, folder, tables.get(key))
        _write_depth(taken, source, folder, pinhole)
    report.progress(len(posed), len(posed), "undistorting", photographs=len(posed))
    return pinholes, float(np.mean(shares))


def _write_picture(photo: Photo, source: Path, folder: Path, tables: _Tables | None) -> None:
    image = read_picture(source / photo.image)
    target = folder / IMAGES / photo.picture
    if tables is None:
        _copy(source / photo.image, target)
    else:
        write_picture_as(
            target, cv2.remap(image, *tables, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        )


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        shutil.copyfile(source, partial)


def _write_mask(photo: Photo, source: Path, folder: Path, tables: _Tables | None) -> None:
    if not photo.mask:
        return
    if tables is None and Path(photo.mask).suffix == ".png":
        _copy(source / photo.mask, folder / mask_file(photo))
        return
    mask = read_picture(source / photo.mask)[..., 0]
    if tables is not None:
        soft = cv2.INTER_LINEAR if photo.outside == TRANSPARENT else cv2.INTER_NEAREST
        mask = cv2.remap(mask, *tables, interpolation=soft, borderMode=cv2.BORDER_REPLICATE)
    write_picture_as(folder / mask_file(photo), mask)


def _write_depth(taken: PosedPhoto, source: Path, folder: Path, pinhole: Camera) -> None:
    """At the depth map's own number of pixels a degree, without interpolation across edges."""
    photo, camera, lens = taken.photo, taken.camera, taken.lens
    if not photo.depth:
        return
    depth = load_depth(source / photo.depth)
    if lens.distorts:
        height, width = depth.shape
        across, down = width / camera.width, height / camera.height
        sides = round(pinhole.width * across), round(pinhole.height * down)
        tables = remap_tables(camera.resized(width, height), lens, pinhole.resized(*sides))
        moved = cv2.remap(depth, *tables, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        depth = np.asarray(moved, np.float32)
    write_depth(folder / depth_file(photo), depth)


def read_picture(path: Path) -> np.ndarray:
    """[H, W, 3] BGR, of a picture that ingest wrote. Raises SplatError "sfm-photo-unreadable"."""
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


def write_picture_as(path: Path, image: np.ndarray) -> None:
    """As PNG or JPEG, by the suffix: lossless photographs stay lossless. Makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".png":
        encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1]
    else:
        encoded = cv2.imencode(".jpg", image, _JPEG)[1]
    with replacing(path) as partial:
        encoded.tofile(partial)
