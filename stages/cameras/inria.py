"""cameras.json of the reference trainer of 3D Gaussian splatting and of programs that grew from it:
https://github.com/graphdeco-inria/gaussian-splatting

A list with one entry for each photograph: the camera's position, its axes as the columns of
`rotation` (camera to world, our axes), and focal lengths in pixels of `width` x `height`. The
principal point is in the middle. Names may lack their suffix. Sparse points lie beside it, in
input.ply.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.base.bad_files import CAMERAS, reading
from stages.cameras.camera_file import (
    CameraFile,
    FilePoints,
    camera_file,
    file_points,
    json_of,
    poses_of,
)
from stages.cameras.lens import Lens
from stages.cameras.nerfstudio import ply_points

_NAME, _POINTS = "cameras.json", "input.ply"
_START = 4096  # bytes, in which the first entry names its photograph


def locate(path: Path) -> Path | None:
    """A list of such entries, itself or in the folder `path`."""
    path = path / _NAME if path.is_dir() else path
    if path.suffix.lower() != ".json" or not path.is_file():
        return None
    with path.open("rb") as file:
        start = file.read(_START)
    is_list = start.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"["
    return path if is_list and b'"img_name"' in start else None


def read(path: Path) -> CameraFile:
    """The cameras in their order. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = json_of(path)
        names = [str(entry["img_name"]) for entry in data]
        optics = []
        for entry in data:
            width, height = float(entry["width"]), float(entry["height"])
            focal = float(entry["fx"]), float(entry["fy"])
            optics.append(([width, height, *focal, width / 2, height / 2], Lens()))
        axes = np.array([entry["rotation"] for entry in data], np.float64).reshape(-1, 3, 3)
        centres = np.array([entry["position"] for entry in data], np.float64).reshape(-1, 3)
        return camera_file(path.parent, names, optics, poses_of(axes.transpose(0, 2, 1), centres))


def read_points(path: Path) -> FilePoints | None:
    """The points that training started from. Raises SplatError "cameras-unreadable"."""
    points = path.parent / _POINTS
    if not points.is_file():
        return None
    with reading(points, CAMERAS):
        return file_points(*ply_points(points))
