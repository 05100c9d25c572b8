"""The camera files of other programs that can be read, in one list.

A new one is a module here with `recognised(path)`, which gives the path to read where `path` is
such a file and None where it is not, and `read(path)`, which gives a `CameraFile` through
`camera_file.make_views`; a line in `CAMERA_FILES`; and `read_points(path)` if it has points.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from stages.base.errors import Family, SplatError
from stages.cameras.camera_file import CameraFile, FilePoints


@dataclass(frozen=True)
class CameraFormat:
    """module: of this room. what: in words, for errors and help."""

    module: str
    what: str


CAMERA_FILES = (
    CameraFormat("opensfm", "OpenSfM's and ODM's reconstruction.json"),
    CameraFormat("nerfstudio", "a transforms.json of nerfstudio's or instant-ngp's"),
    CameraFormat("blender", "a folder with a synthetic NeRF scene's transforms_train.json"),
    CameraFormat("colmap", "a folder with COLMAP's images.bin or images.txt"),
    CameraFormat("llff", "LLFF's poses_bounds.npy"),
    CameraFormat("bundler", "Bundler's .out"),
    CameraFormat("metashape", "Metashape's cameras as .xml"),
    CameraFormat("realityscan", "RealityScan's camera parameters as .csv"),
)
_READ_WITH_IT = (".json", ".bin", ".txt", ".npy", ".ply")  # in a folder of cameras


def read_cameras(path: Path) -> CameraFile:
    """The cameras of any file in the list. Raises SplatError "cameras-unknown" or
    "cameras-unreadable"."""
    module, place = _reader(path)
    found: CameraFile = module.read(place)
    return found


def read_points(path: Path) -> FilePoints | None:
    """The sparse points that go with the cameras, if the file has any. Raises as `read_cameras`."""
    module, place = _reader(path)
    if not hasattr(module, "read_points"):
        return None
    found: FilePoints | None = module.read_points(place)
    return found


def files_of(path: Path) -> list[Path]:
    """The files that cameras are read from: what has to stay for them to stay. Raises
    SplatError."""
    place = _reader(path)[1]
    folder = place if place.is_dir() else place.parent
    suffixes = _READ_WITH_IT if place.is_dir() else (".ply",)
    beside = [child for child in sorted(folder.iterdir()) if child.suffix.lower() in suffixes]
    return [*beside, *([] if place.is_dir() else [place])]


def _reader(path: Path) -> tuple[ModuleType, Path]:
    """(the format's module, what it reads)."""
    for row in CAMERA_FILES:
        module = importlib.import_module(f"stages.cameras.{row.module}")
        place = module.recognised(path)
        if place is not None:
            return module, place
    raise SplatError(
        "cameras-unknown",
        given=f"{path} is no file of cameras that is known here.",
        wanted=f"{'; or '.join(row.what for row in CAMERA_FILES)}.",
        hint="Check the path; a run's cameras are written by `splat cameras RUN OUT`.",
        family=Family.USAGE,
    )
