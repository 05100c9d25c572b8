"""Cameras of ARKit, one .json a frame: frame_*.json of 3D Scanner App, and Polycam's keyframes.

The world is ARKit's: y up by gravity, metres, its heading that of the phone at the start. Poses are
camera to world with OpenGL's axes, by rows. 3D Scanner App writes `cameraPoseARFrame` (16 numbers)
and `intrinsics` (9, in pixels of the picture of the same name), and pictures for some frames only.
Polycam writes `t_00` to `t_23` and the intrinsics with names; `corrected_cameras`, after its own
loop closure, belong to the undistorted `corrected_images`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    CameraFile,
    Georeference,
    camera_file,
    json_of,
    picture_beside,
    poses_of,
    stored_size,
)
from stages.cameras.lens import PINHOLE
from stages.cameras.nerfstudio import OPENGL_FROM_OURS, required

_FRAMES = "frame_*.json"
_POLYCAM = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
_CENTRE = 0.5  # ARKit counts pixels from the centre of the first one, we from its corner
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # ahead stands for north
_SESSION = Georeference(1.0, _UP, "ARKit's tracking")

Posed = tuple[list[float], NDArray[np.float64]]  # w, h, fx, fy, cx, cy; [3, 4] camera to world


def locate(path: Path) -> Path | None:
    """The folder with a .json a frame, in or below the folder `path`."""
    if not path.is_dir():
        return None
    for keyframes in (path, path / "keyframes"):
        for cameras, _ in _POLYCAM:
            if any((keyframes / cameras).glob("*.json")):
                return keyframes / cameras
    if path.name in dict(_POLYCAM) and any(path.glob("*.json")):
        return path
    return path if any(path.glob(_FRAMES)) else None


def read(path: Path) -> CameraFile:
    """The cameras of all frames with a picture, or of all if there is no picture. Raises SplatError
    "cameras-unreadable"."""
    images = dict(_POLYCAM).get(path.name)
    files = sorted(path.glob("*.json" if images else _FRAMES))
    pictures = path.parent / images if images else path
    picture_of = {file: picture_beside(pictures / file.name) for file in files}
    with_picture = [file for file in files if picture_of[file] is not None] or files
    posed = []
    for file in with_picture:
        with reading(file, CAMERAS):
            frame = json_of(file)
            if not isinstance(frame, dict):
                raise BadFileError("it is not an object")
            parse: Callable[..., Posed] = _polycam if images else _scanner_app
            posed.append(parse(frame, picture_of[file]))
    with reading(with_picture[0], CAMERAS):
        names = [getattr(picture_of[file], "name", file.stem) for file in with_picture]
        to_world = np.array([pose for _, pose in posed])
        with np.errstate(all="ignore"):  # `camera_file` checks the result
            rotations = OPENGL_FROM_OURS @ to_world[:, :, :3].transpose(0, 2, 1)
        poses = poses_of(rotations, to_world[:, :, 3])
        optics = [(values, PINHOLE) for values, _ in posed]
        return camera_file(pictures, names, optics, poses, _SESSION)


def _scanner_app(frame: dict[str, Any], picture: Path | None) -> Posed:
    intrinsics = np.array(required(frame, "intrinsics"), np.float64)
    pose = np.array(required(frame, "cameraPoseARFrame"), np.float64)
    if intrinsics.size != 9 or pose.size != 16:
        raise BadFileError("intrinsics are not 9 numbers, or the pose is not 16")
    (fx, _, cx), (_, fy, cy), _ = intrinsics.reshape(3, 3).tolist()
    if picture is None:
        raise BadFileError("its picture is not beside it, and the size of that is needed")
    centre = [cx + _CENTRE, cy + _CENTRE]
    return [*map(float, stored_size(picture)), fx, fy, *centre], pose.reshape(4, 4)[:3]


def _polycam(frame: dict[str, Any], _: Path | None) -> Posed:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    pose = [[float(required(frame, f"t_{i}{j}")) for j in range(4)] for i in range(3)]
    return [float(required(frame, name)) for name in names], np.array(pose)
