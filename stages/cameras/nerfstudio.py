"""nerfstudio's and instant-ngp's transforms.json.

Layout: https://docs.nerf.studio/quickstart/data_conventions.html. A frame's `transform_matrix` is
camera to world with OpenGL's axes: x right, y up, z backward.

The world is z up. We write our y-down world rotated by `applied_transform` (x, z, -y), as
nerfstudio's own import from COLMAP does. So what nerfstudio exports with that transform undone is
in our world again. Reading undoes `applied_scale` and `applied_transform`; a file without them is
read as it is. A frame without a size has that of its picture.
"""

from __future__ import annotations

import json
import math
import os
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from stages.base.atomic import replacing
from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.base.errors import SplatError
from stages.cameras.camera_file import (
    CameraFile,
    FilePoints,
    camera_file,
    check_inside,
    file_points,
    json_of,
    poses_of,
    stored_size,
)
from stages.cameras.lens import Lens
from stages.formats.ply import columns, tables
from stages.formats.ply_header import read_header
from stages.scene import View

OPENGL_FROM_OURS = np.diag([1.0, -1.0, -1.0])
APPLIED_TRANSFORM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = "OPENCV_FISHEYE"
MILLIMETRE = 0.001
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")  # of pictures that are named without one
_ROLES = {"train_filenames": "train", "test_filenames": "test", "val_filenames": "val"}
_LENS = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def write(
    path: Path,
    views: Sequence[View],
    pictures: Path,
    points: NDArray[np.float64] | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write the views. The points go into NAME_points.ply beside NAME.json: nerfstudio
    initialises splats from it. Raises SplatError if a file cannot be written.

    Args:
        path: of transforms.json.
        views: to write.
        pictures: folder that `View.image` is relative to; the file names pictures relative to its
            own folder.
        points: [P, 3].
        colours: [P, 3].
    """
    data: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "applied_transform": np.hstack([APPLIED_TRANSFORM, np.zeros((3, 1))]).tolist(),
    }
    lenses = [_lens(view) for view in views]
    shared = all(lens == lenses[0] for lens in lenses)
    if shared:
        data |= lenses[0]
    if points is not None and colours is not None and len(points):
        beside = points_beside(path)
        _write_points(beside, points @ APPLIED_TRANSFORM.T, colours)
        data["ply_file_path"] = beside.name
    data["frames"] = [
        {
            "file_path": _seen_from(path.parent, pictures / view.image),
            **({} if shared else lens),
            "transform_matrix": _saved_pose(view.camera.world_to_camera).tolist(),
        }
        for view, lens in zip(views, lenses, strict=True)
    ]
    with replacing(path) as partial:
        partial.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def points_beside(path: Path) -> Path:
    """The file that `write` gives the points of the cameras in `path`."""
    return path.with_name(f"{path.stem}_points.ply")  # X.ply may hold the splats of X.json


def y_down(
    views: Sequence[View], points: NDArray[np.float64]
) -> tuple[tuple[View, ...], NDArray[np.float64]]:
    """(views, points [P, 3]) of a world that is z up, in the world that `write` turns into it."""
    turn = np.eye(4)
    turn[:3, :3] = APPLIED_TRANSFORM
    cameras = [
        replace(view.camera, world_to_camera=view.camera.world_to_camera @ turn) for view in views
    ]
    turned = (replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True))
    return tuple(turned), points @ APPLIED_TRANSFORM


def read(path: Path, size: tuple[int, int] | None = None) -> CameraFile:
    """The cameras of a file, named by `file_path`. size: of pictures that are not found and whose
    size the file does not say. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = _document(path)
        frames = data["frames"]
        if not all(isinstance(frame, dict) for frame in frames):
            raise BadFileError("a frame is not an object")
        merged = [ChainMap(frame, data) for frame in frames]
        optics = [(_read_numbers(one, path.parent, size), _read_lens(one)) for one in merged]
        if not np.isfinite([numbers for numbers, _ in optics]).all():
            raise BadFileError("a size or focal length is not a number")
        saved = np.zeros((len(frames), 3, 4))
        for row, frame in zip(saved, frames, strict=True):
            row[:] = np.array(required(frame, "transform_matrix"), np.float64)[:3]
        names = [str(required(frame, "file_path")) for frame in frames]
        cameras = camera_file(path.parent, names, optics, _our_poses(data, saved))
        z_up = np.array_equal(_applied(data)[0], np.eye(3))
        return replace(cameras, views=_with_roles(cameras.views, data), z_up=z_up)


def read_points(path: Path) -> FilePoints | None:
    """The points of `ply_file_path`, if the file names one that is there. Raises SplatError
    "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = _document(path)
        file = _file_of_points(path, data)
    if file is None:
        return None
    with reading(file, CAMERAS):
        points, colours = ply_points(file)
        turn, shift, scale = _applied(data)
        return file_points((points / scale - shift) @ turn, colours)


def files(path: Path) -> list[Path]:
    """The file and the file of its points; a damaged file alone, because reading it says what is
    wrong."""
    try:
        with reading(path, CAMERAS):
            points = _file_of_points(path, _document(path))
    except SplatError:
        points = None
    return [path] if points is None else [path, points]


def _file_of_points(path: Path, data: dict[str, Any]) -> Path | None:
    """`ply_file_path`, if the document names one that is there. Raises BadFileError if it is
    outside the document's folder."""
    named = str(data.get("ply_file_path") or "")
    check_inside(path.parent, named, path.parent)
    return path.parent / named if named and (path.parent / named).is_file() else None


def depth_maps(path: Path) -> tuple[dict[str, Path], float]:
    """(depth maps by `file_path`, the metres of one step of their values). Raises SplatError
    "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = _document(path)
        unit = float(data.get("depth_unit_scale_factor", MILLIMETRE))
        if not (math.isfinite(unit) and unit > 0):
            raise BadFileError("its depth_unit_scale_factor is not a positive number")
        maps = {}
        for frame in data["frames"]:
            if named := str(frame.get("depth_file_path") or ""):
                check_inside(path.parent, named, path.parent)
                maps[str(required(frame, "file_path"))] = path.parent / named
        return maps, unit


def _document(path: Path) -> dict[str, Any]:
    data = json_of(path)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        raise BadFileError("it has no list of frames")
    return data


def _with_roles(views: tuple[View, ...], data: dict[str, Any]) -> tuple[View, ...]:
    roles = {str(name): role for key, role in _ROLES.items() for name in data.get(key) or ()}
    return tuple(replace(view, role=roles.get(view.name, "")) for view in views)


def _saved_pose(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] `transform_matrix` of a camera."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = APPLIED_TRANSFORM @ rotation.T @ OPENGL_FROM_OURS
    pose[:3, 3] = APPLIED_TRANSFORM @ (-rotation.T @ translation)
    return pose + 0.0  # no -0.0


def _our_poses(data: dict[str, Any], saved: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3, 4] world to camera of OpenGL camera-to-world matrices [V, 3, 4]."""
    turn, shift, scale = _applied(data)
    with np.errstate(over="ignore", invalid="ignore"):  # `camera_file` checks the result
        centres = (saved[:, :, 3] / scale - shift) @ turn
        rotations = OPENGL_FROM_OURS @ saved[:, :, :3].transpose(0, 2, 1) @ turn
    return poses_of(rotations, centres)


def _applied(data: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Rotation [3, 3], translation [3] and scale that were applied to the original world."""
    applied = np.array(data.get("applied_transform", np.eye(4)[:3]), np.float64)[:3]
    scale = float(data.get("applied_scale", 1.0))
    turn = applied[:, :3] if applied.shape == (3, 4) else np.zeros((3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        orthogonal = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6
    if not (orthogonal and math.isfinite(applied.sum())):
        raise BadFileError("its applied_transform is not a rotation and a shift")
    if not (math.isfinite(scale) and scale > 0):
        raise BadFileError("its applied_scale is not a positive number")
    return turn, applied[:, 3], scale


def _lens(view: View) -> dict[str, float]:
    camera = view.camera
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return dict(zip(_LENS, lens, strict=True))


def _read_numbers(
    merged: Mapping[str, Any], folder: Path, size: tuple[int, int] | None
) -> list[float]:
    """w, h, fl_x, fl_y, cx, cy of the frame or the file, with instant-ngp's defaults for those that
    may be missing."""
    if "w" in merged and "h" in merged:
        width, height = float(merged["w"]), float(merged["h"])
    else:
        width, height = _picture_size(folder, str(required(merged, "file_path")), size)
    fx = _focal(merged, "x", width, None)
    return [
        width,
        height,
        fx,
        _focal(merged, "y", height, fx),
        float(merged.get("cx", width / 2)),
        float(merged.get("cy", height / 2)),
    ]


def _focal(merged: Mapping[str, Any], axis: str, side: float, otherwise: float | None) -> float:
    """fl_x or fl_y, given directly or by camera_angle_x or _y."""
    angle_key = f"camera_angle_{axis}"
    if f"fl_{axis}" not in merged and angle_key in merged:
        angle = float(merged[angle_key])
        return 0.5 * side / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan
    if otherwise is not None and f"fl_{axis}" not in merged:
        return otherwise
    return float(required(merged, f"fl_{axis}"))


def _picture_size(folder: Path, name: str, otherwise: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height of the picture itself, whose suffix may be missing from its name."""
    check_inside(folder, name, folder)
    for path in (folder / f"{name}{suffix}" for suffix in ("", *_SUFFIXES)):
        if path.is_file():
            return stored_size(path)
    if otherwise is not None:
        return otherwise
    raise BadFileError(f"a frame has no w and h, and its picture {name[:80]} is not found")


def _read_lens(merged: Mapping[str, Any]) -> Lens:
    """The distortion, by nerfstudio's camera models, which include instant-ngp's."""
    model = str(merged.get("camera_model", "OPENCV"))
    fisheye = model == _FISHEYE or bool(merged.get("is_fisheye", False))
    if not fisheye and model not in _PERSPECTIVE:
        raise BadFileError(f"its camera model {model[:40]} is not known")
    k1, k2, k3, k4, p1, p2 = (
        float(merged.get(key) or 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    return Lens("fisheye" if fisheye else "perspective", (k1, k2, k3, k4), tangential=(p1, p2))


def required(values: Mapping[str, Any], key: str) -> Any:
    """A value of a frame. Raises BadFileError if it has none."""
    if key not in values:
        raise BadFileError(f"a frame has no {key}")
    return values[key]


def _seen_from(folder: Path, picture: Path) -> str:
    try:
        return Path(os.path.relpath(picture, folder)).as_posix()
    except ValueError:  # another drive
        return picture.resolve().as_posix()


def _write_points(path: Path, points: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
    names = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), names)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, channel]
    with replacing(path) as partial:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(partial))


def ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Positions [P, 3], and colours [P, 3] or None."""
    with path.open("rb") as file:
        header = read_header(file)
        names = [name for name, _ in header.vertex.properties]
        parts = [table for _, table in tables(file, path, header)]
    if not parts:
        return np.zeros((0, 3)), None
    points = np.concatenate([columns(part, ["x", "y", "z"]) for part in parts]).astype(np.float64)
    channels = ["red", "green", "blue"]
    if not set(channels) <= set(names):
        return points, None
    return points, np.concatenate([columns(part, channels) for part in parts]).astype(np.uint8)
