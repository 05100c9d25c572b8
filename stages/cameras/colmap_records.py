"""The records of COLMAP's model files, binary and text: https://colmap.github.io/format.html.

pycolmap (4.2) is not used: it never returns from a truncated points file, and reads the lens of a
truncated cameras file from uninitialised memory. No memory is allocated by a count that a file
claims.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.cameras.camera_file import Optics
from stages.cameras.lens import Lens

_MODELS = {  # by number: name and how many parameters
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
}
_ONE_FOCAL = (
    *("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
    *("SIMPLE_DIVISION", "SIMPLE_FISHEYE"),
)
POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


@dataclass(frozen=True)
class ImageRecord:
    """camera: its id. pose [7]: quaternion w, x, y, z and translation. seen [n]: 2D points of type
    `POINT2D`; point -1 is none."""

    name: str
    camera: int
    pose: tuple[float, ...]
    seen: NDArray[np.void]


def _optics(model: str, width: int, height: int, params: tuple[float, ...]) -> Optics:
    if not np.isfinite(params).all():
        raise BadFileError("a camera has a parameter that is not a number")
    if model in _ONE_FOCAL:
        params = params[:1] + params
    return (width, height, *params[:4]), _lens(model, params[4:])


def _lens(model: str, k: tuple[float, ...]) -> Lens:
    """k: the parameters after the principal point."""
    kind = "fisheye" if "FISHEYE" in model else "perspective"
    if model == "RAD_TAN_THIN_PRISM_FISHEYE":
        return Lens("prism fisheye", k[:6], tangential=(k[7], k[6]), prism=k[8:])  # type: ignore[arg-type]
    if model == "THIN_PRISM_FISHEYE":
        prism = (k[6], 0.0, k[7], 0.0)
        return Lens(kind, (*k[:2], *k[4:6]), tangential=(k[2], k[3]), prism=prism)
    if model in ("OPENCV", "FULL_OPENCV"):
        return Lens(kind, (*k[:2], *k[4:5]), k[5:], tangential=(k[2], k[3]))
    if model in ("FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM"):
        pinhole = not k[0]  # the limit of FOV, whose formula divides by it
        return Lens() if pinhole else Lens(model.removeprefix("SIMPLE_").lower(), parameters=k)
    return Lens(kind, k)


def binary_cameras(path: Path) -> Iterator[tuple[int, Optics]]:
    """(number, optics) of cameras.bin. Raises BadFileError and struct.error."""
    data, at = path.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, kind, width, height = struct.unpack_from("<IiQQ", data, at)
        if kind not in _MODELS:
            raise BadFileError(f"its camera model {kind} is not known")
        model, count = _MODELS[kind]
        yield number, _optics(model, width, height, struct.unpack_from(f"<{count}d", data, at + 24))
        at += 24 + 8 * count


def binary_images(path: Path) -> Iterator[ImageRecord]:
    """Of images.bin. Raises struct.error and ValueError."""
    data, at = path.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        (count,) = struct.unpack_from("<Q", data, end + 1)
        seen = np.frombuffer(data, POINT2D, count, end + 9)
        yield ImageRecord(data[at + 64 : end].decode(), camera, tuple(pose), seen)
        at = end + 9 + POINT2D.itemsize * count


def binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    """Number, x, y, z, r, g, b, error of points3D.bin. Raises BadFileError and struct.error."""
    data, at = path.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        *row, track = struct.unpack_from("<Q3d3BdQ", data, at)
        at += 51 + 8 * track
        if at > len(data):
            raise BadFileError("it is truncated")
        yield tuple(row)


def _lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8") as file:
        yield from (line.rstrip("\r\n") for line in file if not line.startswith("#"))


def text_cameras(path: Path) -> Iterator[tuple[int, Optics]]:
    """As `binary_cameras`, of cameras.txt. Raises BadFileError and ValueError."""
    counts = dict(_MODELS.values())
    for line in filter(str.strip, _lines(path)):
        number, model, width, height, *params = line.split()
        if counts.get(model) != len(params):
            raise BadFileError(f"its camera model {model[:40]} is not known")
        yield int(number), _optics(model, int(width), int(height), tuple(map(float, params)))


def text_images(path: Path) -> Iterator[ImageRecord]:
    """Of images.txt: two lines each, the second empty if nothing is seen. Raises BadFileError
    and ValueError."""
    lines = _lines(path)
    for line in filter(str.strip, lines):
        _, *pose, camera, name = words = line.split(maxsplit=9)
        if len(words) != 10:
            raise BadFileError("an image lacks a part of its line")
        seen = np.array(next(lines, "").split(), np.float64).reshape(-1, 3)
        points = np.empty(len(seen), POINT2D)
        points["xy"], points["point"] = seen[:, :2], seen[:, 2]
        yield ImageRecord(name.strip(), int(camera), tuple(map(float, pose)), points)


def text_points(path: Path) -> Iterator[tuple[float, ...]]:
    """As `binary_points`, of points3D.txt. Raises ValueError."""
    for line in filter(str.strip, _lines(path)):
        yield tuple(map(float, line.split(maxsplit=8)[:8]))
