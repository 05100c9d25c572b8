"""Bundler's bundle.out: https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html

World to camera, x right, y up, z backward. The principal point is the middle of the picture, and
pixels relative to it are f (1 + k1 r^2 + k2 r^4) p. A file beside it (list.txt; X.list.txt for
COLMAP's X.bundle.out) lists the pictures. A zero and a focal length may follow a name there.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    CameraFile,
    FilePoints,
    camera_file,
    content_of,
    file_points,
    size_of_picture,
)
from stages.cameras.lens import Lens
from stages.cameras.nerfstudio import OPENGL_FROM_OURS

_CAMERA_LINES = 5
_FOCAL = re.compile(r"\s+0\s+[0-9.eE+-]+\s*$")


def read(path: Path) -> CameraFile:
    """The cameras that were registered. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        cameras, _ = _numbers(path)
        names = _names(path)
        if len(names) != len(cameras):
            raise BadFileError(f"it has {len(cameras)} cameras, and its list {len(names)} pictures")
        registered = cameras[:, 0] != 0  # Bundler writes a focal length of 0 for the others
        names = [name for name, there in zip(names, registered, strict=True) if there]
        cameras = cameras[registered]
        sizes = [size_of_picture(path.parent, name) for name in names]
        optics = [
            ((width, height, f, f, width / 2, height / 2), Lens(radial=(k1, k2)))
            for (width, height), (f, k1, k2) in zip(sizes, cameras[:, :3].tolist(), strict=True)
        ]
        with np.errstate(all="ignore"):
            rotations = OPENGL_FROM_OURS @ cameras[:, 3:12].reshape(-1, 3, 3)
            shifts = cameras[:, 12:] @ OPENGL_FROM_OURS
        poses = np.concatenate([rotations, shifts[:, :, None]], axis=2)
        return camera_file(path.parent, names, optics, poses)


def read_points(path: Path) -> FilePoints | None:
    """Its points. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        _, points = _numbers(path)
        return file_points(points[:, :3], points[:, 3:6], points[:, 6])


def _numbers(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cameras [V, 15]: f, k1, k2, rotation, translation; points [P, 7]: position, colour, views."""
    text = content_of(path).decode("utf-8")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    views, count = (int(word) for word in lines[0].split()[:2])
    if views < 0 or count < 0 or len(lines) < 1 + _CAMERA_LINES * views + 3 * count:
        raise BadFileError("it is truncated")
    flat = [
        " ".join(lines[1 + _CAMERA_LINES * i : 1 + _CAMERA_LINES * (i + 1)]).split()
        for i in range(views)
    ]
    cameras = np.array(flat, np.float64).reshape(-1, 15)
    start = 1 + _CAMERA_LINES * views
    rows = []
    for i in range(start, start + 3 * count, 3):
        seen = lines[i + 2].split()[0]
        rows.append([*lines[i].split(), *lines[i + 1].split(), seen])
    return cameras, np.array(rows, np.float64).reshape(-1, 7)


def files(path: Path) -> list[Path]:
    """The file and its list of pictures."""
    file_of_names = _file_of_names(path)
    return [path] if file_of_names is None else [path, file_of_names]


def _names(path: Path) -> list[str]:
    """The name in each line of the list of pictures; it may hold spaces."""
    file_of_names = _file_of_names(path)
    if file_of_names is None:
        raise BadFileError(
            f"there is no list of pictures (list.txt) beside {path.name}",
            hint=f"Write {path.with_name('list.txt')}: the name of one picture a line, in the "
            "order of the cameras.",
        )
    lines = file_of_names.read_text(encoding="utf-8").splitlines()
    return [_FOCAL.sub("", line).strip() for line in lines if line.strip()]


def _file_of_names(path: Path) -> Path | None:
    near = (path.with_suffix(".txt"), path.with_suffix("").with_suffix(".list.txt"),
            path.parent / "list.txt", path.parent.parent / "list.txt",
            path.with_name(f"{path.name}.list.txt"))  # fmt: skip
    return next((file for file in near if file.is_file()), None)
