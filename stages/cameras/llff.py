"""poses_bounds.npy of LLFF: https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap

Each row has 17 numbers, in the order of the pictures' names: a matrix [3, 5], and the nearest and
farthest depth. The columns of the matrix are the camera's down, right and backward directions, its
position, and the height, width and focal length in pixels.
"""

from __future__ import annotations

import io
import tokenize
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.base.text import reason_of
from stages.cameras.camera_file import CameraFile, camera_file, content_of, poses_of
from stages.cameras.lens import PINHOLE

_NAME = "poses_bounds.npy"
_COLUMNS = 17
_PICTURES = (".jpg", ".jpeg", ".png")


def locate(path: Path) -> Path | None:
    """The file itself, or in the folder `path`."""
    if path.suffix.lower() == ".npy":
        return path
    return path / _NAME if (path / _NAME).is_file() else None


def read(path: Path) -> CameraFile:
    """The cameras. Pictures are in a folder "images..." beside the file (of several, the one with
    the shortest name), or beside the file itself. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        rows = _rows(content_of(path))
        names = _names(path.parent, len(rows))
        matrices = rows[:, :15].reshape(-1, 3, 5)
        down, right, backward, centre, camera = np.moveaxis(matrices, 2, 0)
        rotations = np.stack([right, down, -backward], axis=1)
        optics = [
            ((width, height, focal, focal, width / 2, height / 2), PINHOLE)
            for height, width, focal in camera.tolist()
        ]
        return camera_file(path.parent, names, optics, poses_of(rotations, centre))


def _rows(data: bytes) -> NDArray[np.float64]:
    """[V, 17] of the file. `np.load` is not used because it allocates what a header claims."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read_header = np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = read_header(file)
    except (tokenize.TokenError, SyntaxError) as error:
        raise BadFileError(f"its header is damaged ({reason_of(error)})") from error
    if len(shape) != 2 or shape[1] != _COLUMNS or dtype.kind != "f":
        raise BadFileError(f"it is not a table of {_COLUMNS} columns")
    count = shape[0] * _COLUMNS
    if count * dtype.itemsize > len(data) - file.tell():
        raise BadFileError("it is truncated")
    rows = np.frombuffer(data, dtype, count, file.tell())
    return rows.reshape(shape, order="F" if by_columns else "C").astype(np.float64)


def _names(folder: Path, count: int) -> list[str]:
    """The pictures of the first folder that holds `count` of them, by length of its name."""
    folders = [child for child in folder.glob("images*") if child.is_dir()]
    for near in [*sorted(folders, key=lambda child: (len(child.name), child.name)), folder]:
        pictures = sorted(p for p in near.iterdir() if p.suffix.lower() in _PICTURES)
        if len(pictures) == count:
            return [picture.relative_to(folder).as_posix() for picture in pictures]
    raise BadFileError(
        f"it has {count} cameras, and no folder of images beside it has as many pictures"
    )
