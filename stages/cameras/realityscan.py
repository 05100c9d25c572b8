"""RealityScan's (RealityCapture's) "Internal/External camera parameters" as .csv.

z is up. Heading, pitch and roll are in degrees. A camera at 0, 0, 0 looks straight down, with the
top of its picture to the north (+y). Heading (clockwise from north) and pitch (above the horizon)
say where that top points, and roll turns the camera about it. f, px and py are in units of 1/36 of
the longer side, the principal point relative to the middle. k1 to k4, t1 and t2 are OpenCV's.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.base.text import reason_of
from stages.cameras.camera_file import (
    CameraFile,
    Optics,
    camera_file,
    content_of,
    poses_of,
    size_of_picture,
)
from stages.cameras.lens import Lens
from stages.cameras.nerfstudio import OPENGL_FROM_OURS

_LONGER_SIDE = 36.0  # in the file's own unit
_PLACE = ("x", "y", "alt", "heading", "pitch", "roll")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")


def read(path: Path) -> CameraFile:
    """The cameras of all rows; their pictures are beside the file, or in images/ there. Raises
    SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        rows = _rows(path)
        names = [row["name"] for row in rows]
        placed = np.array([[float(row[key]) for key in _PLACE] for row in rows], np.float64)
        if not np.isfinite(placed).all():
            raise BadFileError("it holds a value that is not a number")
        optics = [_optics(row, *size_of_picture(path.parent, row["name"])) for row in rows]
        poses = poses_of(_world_to_camera(placed[:, 3:]), placed[:, :3])
        return camera_file(path.parent, names, optics, poses)


def _rows(path: Path) -> list[dict[str, str]]:
    text = content_of(path).decode("utf-8-sig")
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        columns = [column.strip().lstrip("#").lower() for column in reader.fieldnames or ()]
        reader.fieldnames = columns
        missing = [key for key in ("name", *_PLACE, "f") if key not in columns]
        if missing:
            raise BadFileError(f"it has no column {missing[0]!r}")
        rows = [row for row in reader if row["name"]]
    except csv.Error as error:
        raise BadFileError(f"it is damaged ({reason_of(error)})") from error
    if any(None in row or None in row.values() for row in rows):
        raise BadFileError("a row is incomplete")
    if not rows:
        raise BadFileError("it holds no camera")
    return rows


def _optics(row: dict[str, str], width: int, height: int) -> Optics:
    scale = max(width, height) / _LONGER_SIDE
    focal = float(row["f"]) * scale
    px, py, k1, k2, k3, k4, t1, t2 = (float(row.get(key) or 0) for key in _OPTIONAL)
    centre = width / 2 + px * scale, height / 2 + py * scale
    return (width, height, focal, focal, *centre), Lens(
        radial=(k1, k2, k3, k4), tangential=(t1, t2)
    )


def _world_to_camera(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3, 3], with our axes of the camera, of heading, pitch and roll [V, 3], degrees."""
    to_world = Rotation.from_euler("ZXY", angles * (-1, 1, 1), degrees=True).as_matrix()
    return np.asarray(OPENGL_FROM_OURS @ to_world.transpose(0, 2, 1))
