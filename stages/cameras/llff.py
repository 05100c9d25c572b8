"""poses_bounds.npy of LLFF: https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap

A row of 17 numbers a picture, in order of the pictures' names: a matrix [3, 5] and the nearest and
farthest depth. The matrix's columns are where the camera's down, right and backward point, its
position, and height, width and focal length in pixels.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import CameraFile, make_views
from stages.cameras.lens import PINHOLE

_NAME = "poses_bounds.npy"
_PICTURES = (".jpg", ".jpeg", ".png")


def recognised(path: Path) -> Path | None:
    """The file itself, or in the folder `path`."""
    if path.suffix.lower() == ".npy":
        return path
    return path / _NAME if (path / _NAME).is_file() else None


def read(path: Path) -> CameraFile:
    """The cameras of the pictures in a folder beside the file that begins with "images" (the
    largest ones), or beside the file itself. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        rows = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
        if rows.ndim != 2 or rows.shape[1] not in (15, 17) or rows.dtype.kind != "f":
            raise BadFileError("it is no table of 17 numbers a picture")
        names = _names(path.parent, len(rows))
        matrices = rows[:, :15].reshape(-1, 3, 5).astype(np.float64)
        down, right, backward, centre, sizes = np.moveaxis(matrices, 2, 0)
        rotations = np.stack([right, down, -backward], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            shifts = -np.einsum("vij,vj->vi", rotations, centre)
        height, width, focal = sizes.T
        lens = np.stack([focal, focal, width / 2, height / 2], axis=1)
        poses = np.concatenate([rotations, shifts[:, :, None]], axis=2)
        views = make_views(names, np.stack([width, height], axis=1), lens, poses)
        return CameraFile(views, path.parent, (PINHOLE,) * len(views))


def _names(folder: Path, count: int) -> list[str]:
    """From `folder`; of all folders that hold as many pictures, the one with the shortest name."""
    folders = [child for child in folder.glob("images*") if child.is_dir()]
    for place in [*sorted(folders, key=lambda child: (len(child.name), child.name)), folder]:
        pictures = sorted(p for p in place.iterdir() if p.suffix.lower() in _PICTURES)
        if len(pictures) == count:
            return [picture.relative_to(folder).as_posix() for picture in pictures]
    raise BadFileError(f"it speaks of {count} pictures, and no folder of images beside it has them")
