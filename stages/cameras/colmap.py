"""COLMAP's sparse model: cameras, images and points, read as binary or text, written as binary.

Layout: https://colmap.github.io/format.html (binary files hold the same fields as the text files,
little-endian). Records are written in order of id, so that equal models give equal bytes. Axes are
the same as ours, and the world is not transformed. The test photographs may be listed by name in
test.txt beside these files, one a line, as the reference trainer reads it.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing, temporary_beside
from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras import colmap_records as records
from stages.cameras.camera_file import NO_POINTS, CameraFile, FilePoints, camera_file
from stages.cameras.colmap_records import POINT2D, ImageRecord
from stages.scene import Camera
from stages.scene.rotations import matrices_of, quaternions_of

_PINHOLE = 1
_TEST = "test.txt"  # names of the test photographs


@dataclass(frozen=True)
class Observations:
    """points [O], views [O], px [O, 2]: which point each view observes at which pixel of its
    undistorted picture; sorted by point, then view."""

    points: NDArray[np.int32]
    views: NDArray[np.int32]
    px: NDArray[np.float64]


NO_OBSERVATIONS = Observations(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)))


def write_model(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    cloud: FilePoints = NO_POINTS,
    observations: Observations = NO_OBSERVATIONS,
) -> None:
    """Write the three files into `folder`, which is created, all or none. Ids are positions + 1.

    Args:
        folder: for the files.
        names: V picture paths, relative to the folder of pictures.
        cameras: of the V views; views with equal intrinsics share one camera in the file.
        cloud: points.
        observations: of these points.

    Raises SplatError if they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with temporary_beside(folder / "cameras.bin") as path:
        _write_files(path.parent, names, cameras, cloud, observations)
        for file in sorted(path.parent.iterdir()):
            os.replace(file, folder / file.name)


def _write_files(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    cloud: FilePoints,
    observations: Observations,
) -> None:
    """See `write_model`."""
    intrinsics = [_intrinsics(camera) for camera in cameras]
    distinct = sorted(set(intrinsics), key=intrinsics.index)
    camera_ids = {values: number for number, values in enumerate(distinct, 1)}
    with replacing(folder / "cameras.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(distinct)))
        for (width, height, *params), number in camera_ids.items():
            file.write(struct.pack("<IiQQ4d", number, _PINHOLE, width, height, *params))
    # by_view lists observations view by view; rank is an observation's number within its view.
    by_view = np.argsort(observations.views, kind="stable")
    counts = np.bincount(observations.views, minlength=len(names))
    starts = np.concatenate([[0], np.cumsum(counts)])
    rank = np.empty(len(by_view), np.int64)
    rank[by_view] = np.arange(len(by_view)) - np.repeat(starts[:-1], counts)
    with replacing(folder / "images.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for view, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            pose = (
                *quaternions_of(camera.world_to_camera[:3, :3]),
                *camera.world_to_camera[:3, 3],
            )
            file.write(struct.pack("<I7dI", view + 1, *pose, camera_ids[intrinsics[view]]))
            file.write(name.encode() + b"\0")
            rows = by_view[starts[view] : starts[view + 1]]
            points2d = np.empty(len(rows), POINT2D)
            points2d["xy"] = observations.px[rows]
            points2d["point"] = observations.points[rows] + 1
            file.write(struct.pack("<Q", len(rows)) + points2d.tobytes())
    elements = np.stack([observations.views + 1, rank], axis=1).astype("<u4")
    starts = np.searchsorted(observations.points, np.arange(len(cloud.points) + 1))
    tracks = [elements[start:end] for start, end in itertools.pairwise(starts)]
    _write_points(folder / "points3D.bin", cloud, tracks)


def _write_points(target: Path, cloud: FilePoints, tracks: list[NDArray[np.uint32]]) -> None:
    with replacing(target) as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(cloud.points)))
        rows = zip(cloud.points, cloud.colours, cloud.errors_px, tracks, strict=True)
        for number, (xyz, rgb, error, track) in enumerate(rows, 1):
            file.write(struct.pack("<Q3d3BdQ", number, *xyz, *rgb, error, len(track)))
            file.write(track.tobytes())


def _intrinsics(camera: Camera) -> tuple[int, int, float, float, float, float]:
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy


def locate(path: Path) -> Path | None:
    """The folder of the model: `path` itself, or one of the usual places inside."""
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "colmap" / "sparse" / "0"):
        if any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder
    return None


def files(folder: Path) -> list[Path]:
    """The files of the model that are read."""
    stems = ("cameras", "images", "points3D")
    names = (*(f"{stem}.{kind}" for stem in stems for kind in ("bin", "txt")), _TEST)
    return [folder / name for name in names if (folder / name).is_file()]


def read(folder: Path) -> CameraFile:
    """The cameras of a model, in the order of the file; pictures are in a folder `images` near the
    model. Raises SplatError "cameras-unreadable"."""
    return _read(folder)[0]


def read_model(folder: Path) -> tuple[CameraFile, FilePoints, Observations]:
    """Cameras, points and observations; keypoints without a 3D point are left out.

    Raises SplatError "cameras-unreadable".
    """
    found, images = _read(folder)
    path, text = _part(folder, "points3D")
    with reading(path, CAMERAS):
        rows = np.array(
            list((records.text_points if text else records.binary_points)(path)), np.float64
        )
        rows = rows.reshape(-1, 8)
        if not np.isfinite(rows).all() or (np.abs(rows[:, 4:7] - 127.5) > 127.5).any():
            raise BadFileError("a point has a value that is not a number or not a colour")
        ids = rows[:, 0].astype(np.int64)
        order = np.argsort(ids, kind="stable")
        views = np.repeat(np.arange(len(images)), [len(image.seen) for image in images])
        seen = np.concatenate([image.seen for image in images])
        place = np.searchsorted(ids[order], seen["point"])
        known = np.isin(seen["point"], ids)
        points = order[place[known]].astype(np.int32)
        sort = np.lexsort((views[known], points))
        tracks = np.bincount(points, minlength=len(rows)).astype(np.int32)
        cloud = FilePoints(rows[:, 1:4], rows[:, 4:7].astype(np.uint8), rows[:, 7], tracks)
        observing = views[known][sort].astype(np.int32)
        return found, cloud, Observations(points[sort], observing, seen["xy"][known][sort])


def read_points(folder: Path) -> FilePoints | None:
    """The model's points; None if the folder has none, or an empty points3D.txt, as COLMAP's own
    manual advises for known cameras. Raises SplatError "cameras-unreadable"."""
    path, text = _part(folder, "points3D")
    if not path.is_file() or (text and not path.stat().st_size):
        return None
    return read_model(folder)[1]


def _part(folder: Path, name: str) -> tuple[Path, bool]:
    """(the file, whether it is text); the binary one if both exist, as COLMAP does."""
    binary = folder / f"{name}.bin"
    text = folder / f"{name}.txt"
    return (text, True) if text.is_file() and not binary.is_file() else (binary, False)


def _read(folder: Path) -> tuple[CameraFile, list[ImageRecord]]:
    path, text = _part(folder, "cameras")
    with reading(path, CAMERAS):
        optics = dict((records.text_cameras if text else records.binary_cameras)(path))
    path, text = _part(folder, "images")
    with reading(path, CAMERAS):
        images = list((records.text_images if text else records.binary_images)(path))
        missing = {image.camera for image in images} - optics.keys()
        if missing:
            raise BadFileError(f"there is no camera {min(missing)}")
        poses = np.array([image.pose for image in images], np.float64).reshape(-1, 7)
        with np.errstate(invalid="ignore"):  # `camera_file` rejects a quaternion of length 0
            rotations = matrices_of(poses[:, :4])
        own = [optics[image.camera] for image in images]
        matrices = np.concatenate([rotations, poses[:, 4:, None]], axis=2)
        near = [base / "images" for base in (folder, folder.parent, folder.parent.parent)]
        pictures = next((path for path in near if path.is_dir()), near[0])
        names = [image.name for image in images]
        found = camera_file(pictures, names, own, matrices)
    return _with_roles(found, folder / _TEST), images


def _with_roles(found: CameraFile, test: Path) -> CameraFile:
    """The cameras with the roles that the list of test photographs gives them, if there is one.
    Names without a camera are of photographs that were not registered."""
    if not test.is_file():
        return found
    with reading(test, CAMERAS):
        listed = {line.strip() for line in test.read_text(encoding="utf-8-sig").splitlines()}
    roles = ["test" if view.name in listed else "train" for view in found.views]
    views = [replace(view, role=role) for view, role in zip(found.views, roles, strict=True)]
    return replace(found, views=tuple(views))
