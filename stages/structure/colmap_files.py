"""COLMAP's binary model: cameras.bin, images.bin, points3D.bin.

Layout: https://colmap.github.io/format.html (binary files hold the same fields as the text files,
little-endian). Records are written in order of id, so that equal models give equal bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.run.atomic import replacing
from stages.scene import Camera

_PINHOLE = 1


@dataclass(frozen=True)
class ColmapModel:
    """Pinhole views and points. Ids in the files are positions + 1.

    names [V] picture paths. cameras [V]: the pose of each view; views with equal intrinsics share
    one camera. points [P, 3], colours [P, 3] uint8, errors_px [P].
    observed_points [O], observing_views [O], observed_px [O, 2]; sorted by point, then view.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    errors_px: NDArray[np.float64]
    observed_points: NDArray[np.int32]
    observing_views: NDArray[np.int32]
    observed_px: NDArray[np.float64]


def write_colmap_model(folder: Path, model: ColmapModel) -> None:
    """Write the three files into `folder`, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics = [_intrinsics(camera) for camera in model.cameras]
    distinct = sorted(set(intrinsics), key=intrinsics.index)
    camera_ids = {values: number for number, values in enumerate(distinct, 1)}
    with replacing(folder / "cameras.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(distinct)))
        for (width, height, *params), number in camera_ids.items():
            file.write(struct.pack("<IiQQ4d", number, _PINHOLE, width, height, *params))
    # by_view lists observations view by view; rank is an observation's number within its view.
    by_view = np.argsort(model.observing_views, kind="stable")
    counts = np.bincount(model.observing_views, minlength=len(model.names))
    starts = np.concatenate([[0], np.cumsum(counts)])
    rank = np.empty(len(by_view), np.int64)
    rank[by_view] = np.arange(len(by_view)) - np.repeat(starts[:-1], counts)
    with replacing(folder / "images.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(model.names)))
        for view, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
            pose = (
                *rotation_to_quaternion(camera.world_to_camera[:3, :3]),
                *camera.world_to_camera[:3, 3],
            )
            file.write(struct.pack("<I7dI", view + 1, *pose, camera_ids[intrinsics[view]]))
            file.write(name.encode() + b"\0")
            rows = by_view[starts[view] : starts[view + 1]]
            points2d = np.empty(len(rows), np.dtype([("xy", "<f8", 2), ("point", "<i8")]))
            points2d["xy"] = model.observed_px[rows]
            points2d["point"] = model.observed_points[rows] + 1
            file.write(struct.pack("<Q", len(rows)) + points2d.tobytes())
    _write_points(folder / "points3D.bin", model, rank)


def _write_points(target: Path, model: ColmapModel, rank: NDArray[np.int64]) -> None:
    starts = np.searchsorted(model.observed_points, np.arange(len(model.points) + 1))
    elements = np.stack([model.observing_views + 1, rank], axis=1).astype("<u4")
    with replacing(target) as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(model.points)))
        for point, (xyz, rgb, error) in enumerate(
            zip(model.points, model.colours, model.errors_px, strict=True)
        ):
            track = elements[starts[point] : starts[point + 1]]
            file.write(struct.pack("<Q3d3BdQ", point + 1, *xyz, *rgb, error, len(track)))
            file.write(track.tobytes())


def _intrinsics(camera: Camera) -> tuple[int, int, float, float, float, float]:
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy


def rotation_to_quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] w, x, y, z, w >= 0, of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric
    matrix (J. Guidance 23(6), 2000), which is stable for every angle."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(matrix)[1][:, 3]
    return quaternion if quaternion[0] >= 0 else -quaternion
