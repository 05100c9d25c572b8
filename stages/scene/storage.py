"""Splats on disk between stages: exact, deterministic, and quick to load.

Layout: the 8 bytes of `MAGIC`, then each array in the order of `FIELDS` and one for `DrawSettings`,
in NumPy's .npy format (version 1.0). Where the splats have a place on the earth, an array of bytes
follows with its JSON in UTF-8, and where they have a first camera, one of its numbers. There is no
compression and no timestamp (a zip file, and so .npz, would have them), so equal splats give equal
bytes.
"""

from __future__ import annotations

import json
import math
from dataclasses import astuple
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import reading, stage_output
from stages.scene.camera import Camera
from stages.scene.draw_settings import DrawSettings
from stages.scene.place import EarthPlace
from stages.scene.splats import ROW_FIELDS, Splats

MAGIC = b"SPLATS5\n"
FIELDS = (*ROW_FIELDS, "origin")
FILE_NAME = "splats.bin"
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "world_to_camera")
_DTYPES = {"<f4", "<f8", "|u1"}


def save_splats(path: Path, splats: Splats) -> Path:
    """Write `splats` to `path` (to `FILE_NAME` inside, if `path` is a folder); return the file.

    Float arrays keep their type (float32 or float64), little-endian. Written atomically.
    Raises SplatError if the file cannot be written.
    """
    target = _file_of(path)
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(MAGIC)
        for name in FIELDS:
            array = np.ascontiguousarray(getattr(splats, name))
            array = array.astype(array.dtype.newbyteorder("<"), copy=False)
            npy.write_array(file, array, version=(1, 0), allow_pickle=False)
        draw_settings = np.array(astuple(splats.draw_settings), "<f8")
        npy.write_array(file, draw_settings, version=(1, 0), allow_pickle=False)
        if splats.place is not None:
            text = np.frombuffer(json.dumps(splats.place.to_json()).encode(), np.uint8)
            npy.write_array(file, text, version=(1, 0), allow_pickle=False)
        if splats.first_camera is not None:
            *lens, pose = (getattr(splats.first_camera, name) for name in _CAMERA)
            npy.write_array(file, np.array([*lens, *pose.flat], "<f8"), version=(1, 0))
    return target


def load_splats(path: Path) -> Splats:
    """The splats that `save_splats` wrote to `path` (a file, or the folder that holds it).

    Raises SplatError "splats-file-damaged" if it is missing, cut short or not such a file.
    """
    source = _file_of(path)
    with reading(source, stage_output("splats-file-damaged")), source.open("rb") as file:
        size = source.stat().st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it does not start as a splats file")
        arrays = {name: _read_array(file, size, name) for name in FIELDS}
        drawn = _read_array(file, size, "draw settings").astype(np.float64)
        near, side, grey, light, antialias = drawn[:5]  # files of earlier versions have six
        place, camera = None, None
        while file.tell() < size:
            array = _read_array(file, size, "what follows")
            if array.dtype == np.uint8 and place is None and camera is None:
                place = EarthPlace.from_json(json.loads(array.tobytes()))
            elif array.shape == (22,) and camera is None:
                width, height, fx, fy, cx, cy = array[:6].tolist()
                pose = array[6:].astype(np.float64).reshape(4, 4)
                camera = Camera(int(width), int(height), fx, fy, cx, cy, pose)
            else:
                raise ValueError("bytes follow its end")
        draw_settings = DrawSettings(
            float(near), int(side), float(grey), bool(light), bool(antialias)
        )
        return Splats(
            **arrays,  # type: ignore[arg-type]
            draw_settings=draw_settings,
            place=place,
            first_camera=camera,
        )


def _file_of(path: Path) -> Path:
    path = Path(path)
    return path / FILE_NAME if path.is_dir() else path


def _read_array(file: BinaryIO, file_bytes: int, name: str) -> NDArray[np.generic]:
    """One array in .npy format; its size is checked against the file before memory is allocated."""
    if npy.read_magic(file) != (1, 0):
        raise ValueError(f"{name} has another version")
    try:
        shape, fortran_order, dtype = npy.read_array_header_1_0(file)
    except Exception as error:  # NumPy evaluates the header: what it raises depends on the damage
        raise ValueError(f"{name} has a damaged header") from error
    if fortran_order or dtype.str not in _DTYPES or min(shape, default=0) < 0:
        raise ValueError(f"{name} is laid out in another way")
    count = math.prod(shape)
    if count * dtype.itemsize > file_bytes - file.tell():
        raise ValueError(f"{name} is cut short")
    array: NDArray[np.generic] = np.fromfile(file, dtype, count)
    return array.reshape(shape)
