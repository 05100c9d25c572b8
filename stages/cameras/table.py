"""The camera files of other programs that can be read, in one list.

A new one is a module here with `recognised(path)`, which gives the path to read where `path` is
such a file and None where it is not, and `read(path)`, which gives a `CameraFile` through
`camera_file.make_views`; and a line in `CAMERA_FILES`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path

from stages.base.errors import Family, SplatError
from stages.cameras.camera_file import CameraFile


@dataclass(frozen=True)
class CameraFormat:
    """module: of this room. what: in words, for errors and help."""

    module: str
    what: str


CAMERA_FILES = (
    CameraFormat("nerfstudio", "nerfstudio's transforms.json"),
    CameraFormat("colmap", "a folder with COLMAP's images.bin or images.txt"),
)


def read_cameras(path: Path) -> CameraFile:
    """The cameras of any file in the list. Raises SplatError "cameras-unknown" or
    "cameras-unreadable"."""
    for row in CAMERA_FILES:
        module = importlib.import_module(f"stages.cameras.{row.module}")
        place = module.recognised(path)
        if place is not None:
            found: CameraFile = module.read(place)
            return found
    raise SplatError(
        "cameras-unknown",
        given=f"{path} is no file of cameras that is known here.",
        wanted=f"{' or '.join(row.what for row in CAMERA_FILES)}.",
        hint="Check the path; a run's cameras are written by `splat cameras RUN OUT`.",
        family=Family.USAGE,
    )
