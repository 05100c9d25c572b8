"""nerfstudio's transforms.json.

Layout: https://docs.nerf.studio/quickstart/data_conventions.html. A frame's `transform_matrix` is
camera to world with OpenGL's axes: x right, y up, z backward.

The world: z up. We write our y-down world turned by `applied_transform` (x, z, -y), the same turn
as nerfstudio's own import from COLMAP makes, so that what it exports with the turn undone is in
our world again. Reading undoes `applied_scale` and `applied_transform`; a file without them is
taken to be in the world that it was made for.
"""

from __future__ import annotations

import json
import math
import os
from collections import ChainMap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import CameraFile, make_views
from stages.scene import View

OPENGL_FROM_OURS = np.diag([1.0, -1.0, -1.0])
SAVED_FROM_OURS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LENS = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def write(
    path: Path,
    views: Sequence[View],
    pictures: Path,
    points: NDArray[np.float64] | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write the views; what `View.image` names starts from `pictures`, and is named from the
    file's own folder. points [P, 3] and colours [P, 3], where there are any, go into a .ply of
    the same name beside it, where nerfstudio finds its first splats.

    Raises SplatError when a file cannot be written.
    """
    data: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "applied_transform": np.hstack([SAVED_FROM_OURS, np.zeros((3, 1))]).tolist(),
    }
    lenses = [_lens(view) for view in views]
    shared = all(lens == lenses[0] for lens in lenses)
    if shared:
        data |= lenses[0]
    if points is not None and colours is not None and len(points):
        beside = path.with_suffix(".ply")
        _write_points(beside, points @ SAVED_FROM_OURS.T, colours)
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


def recognised(path: Path) -> Path | None:
    """The path itself, if it is a .json file."""
    return path if path.suffix.lower() == ".json" else None


def read(path: Path) -> CameraFile:
    """The cameras of a file; `file_path` gives their names. Raises SplatError
    "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
            raise BadFileError("it has no list of frames")
        frames = data["frames"]
        if not all(isinstance(frame, dict) for frame in frames):
            raise BadFileError("a frame is not an object")
        lenses = np.array([_read_lens(data, frame) for frame in frames], np.float64).reshape(-1, 6)
        if not np.isfinite(lenses).all():
            raise BadFileError("a size or focal length is not a number")
        saved = np.zeros((len(frames), 3, 4))
        for row, frame in zip(saved, frames, strict=True):
            row[:] = np.array(_wanted(frame, "transform_matrix"), np.float64)[:3]
        names = [str(_wanted(frame, "file_path")) for frame in frames]
        views = make_views(names, lenses[:, :2], lenses[:, 2:], _our_poses(data, saved))
        return CameraFile(views, path.parent, sum(_is_distorted(data, frame) for frame in frames))


def _saved_pose(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] OpenGL camera to saved world."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = SAVED_FROM_OURS @ rotation.T @ OPENGL_FROM_OURS
    pose[:3, 3] = SAVED_FROM_OURS @ (-rotation.T @ translation)
    return pose + 0.0  # no -0.0


def _our_poses(data: dict[str, Any], saved: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3, 4] world to camera of OpenGL camera-to-world matrices [V, 3, 4]."""
    applied = np.array(data.get("applied_transform", np.eye(4)[:3]), np.float64)[:3]
    scale = float(data.get("applied_scale", 1.0))
    turn = applied[:, :3] if applied.shape == (3, 4) else np.zeros((3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        orthogonal = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6
    if not (orthogonal and math.isfinite(applied.sum())):
        raise BadFileError("its applied_transform is not a rotation and a shift")
    if not (math.isfinite(scale) and scale > 0):
        raise BadFileError("its applied_scale is not a positive number")
    with np.errstate(over="ignore", invalid="ignore"):  # `make_views` looks at what comes out
        centres = (saved[:, :, 3] / scale - applied[:, 3]) @ turn
        rotations = OPENGL_FROM_OURS @ saved[:, :, :3].transpose(0, 2, 1) @ turn
        shifts = -np.einsum("vij,vj->vi", rotations, centres)
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def _lens(view: View) -> dict[str, float]:
    camera = view.camera
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return dict(zip(_LENS, lens, strict=True))


def _read_lens(data: dict[str, Any], frame: dict[str, Any]) -> list[float]:
    """w, h, fl_x, fl_y, cx, cy: the frame's own, or the file's. Those that may be missing have
    instant-ngp's defaults."""
    merged = ChainMap(frame, data)
    model = str(merged.get("camera_model", "OPENCV"))
    if model not in _PERSPECTIVE:
        raise BadFileError(f"its camera model is {model[:40]}, which is no perspective")
    width, height = float(_wanted(merged, "w")), float(_wanted(merged, "h"))
    if "fl_x" not in merged and "camera_angle_x" in merged:
        angle = float(merged["camera_angle_x"])
        fx = 0.5 * width / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan
    else:
        fx = float(_wanted(merged, "fl_x"))
    fy = float(merged.get("fl_y", fx))
    return [
        width,
        height,
        fx,
        fy,
        float(merged.get("cx", width / 2)),
        float(merged.get("cy", height / 2)),
    ]


def _is_distorted(data: dict[str, Any], frame: dict[str, Any]) -> bool:
    merged = ChainMap(frame, data)
    return any(float(merged.get(key) or 0.0) != 0.0 for key in _DISTORTION)


def _wanted(values: Mapping[str, Any], key: str) -> Any:
    if key not in values:
        raise BadFileError(f"a frame has no {key}")
    return values[key]


def _seen_from(folder: Path, picture: Path) -> str:
    try:
        return Path(os.path.relpath(picture, folder)).as_posix()
    except ValueError:  # another drive
        return picture.resolve().as_posix()


def _write_points(path: Path, points: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
    from plyfile import PlyData, PlyElement

    names = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), names)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, channel]
    with replacing(path) as partial:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(partial))
