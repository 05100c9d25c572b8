"""The camera files of other programs that can be read, in one list.

To add one:

1. Write a module here with `locate(path)`, which returns the path to read, or None if `path` is not
   such a file. A format that its suffix identifies needs none: its row names the suffix.
2. Give it `read(path)`, which returns a `CameraFile` made by `camera_file.camera_file`.
3. Give it `read_points(path)` if the file has sparse points, and `files(path)` if other files than
   the .ply beside it, or those of the folder, are read with it.
4. Add a row to `CAMERA_FILES`; the first format that locates a file reads it.
5. Add a writer to `tests/cameras/drawn.py`: the tests run over all of them.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from stages.base.errors import UsageError
from stages.cameras.camera_file import CameraFile, FilePoints


@dataclass(frozen=True)
class CameraFormat:
    """A row of the list. module: in this package. description: for errors and help. suffix: of the
    files that the format reads; "" if its module locates them."""

    module: str
    description: str
    suffix: str = ""


CAMERA_FILES = (
    CameraFormat("opensfm", "OpenSfM's and ODM's reconstruction.json"),
    CameraFormat("arkit", "a folder with ARKit's frame_*.json, or Polycam's keyframes"),
    CameraFormat("nerfstudio", "a transforms.json of nerfstudio's or instant-ngp's", ".json"),
    CameraFormat("blender", "a folder with a synthetic NeRF scene's transforms_train.json"),
    CameraFormat("colmap", "a folder with COLMAP's images.bin or images.txt"),
    CameraFormat("llff", "LLFF's poses_bounds.npy"),
    CameraFormat("bundler", "Bundler's .out", ".out"),
    CameraFormat("metashape", "Metashape's cameras as .xml", ".xml"),
    CameraFormat("realityscan", "RealityScan's camera parameters as .csv", ".csv"),
    CameraFormat("realityscan_xmp", "a folder with RealityScan's .xmp beside the photographs"),
    CameraFormat("opf", "Pix4D's project.opf"),
)
_READ_TOGETHER = (".json", ".bin", ".txt", ".npy", ".ply", ".xmp")  # in a folder of cameras


def read_cameras(path: Path) -> CameraFile:
    """The cameras of a file of any listed format. Raises SplatError "cameras-unknown" or
    "cameras-unreadable"."""
    module, source = _reader(path)
    found: CameraFile = module.read(source)
    return found


def read_points(path: Path) -> FilePoints | None:
    """The sparse points of the file, if it has any. Raises as `read_cameras`."""
    module, source = _reader(path)
    if not hasattr(module, "read_points"):
        return None
    found: FilePoints | None = module.read_points(source)
    return found


def files_of(path: Path) -> list[Path]:
    """All files that the cameras are read from. Raises SplatError."""
    module, source = _reader(path)
    if hasattr(module, "files"):
        found: list[Path] = module.files(source)
        return found
    folder = source if source.is_dir() else source.parent
    suffixes = _READ_TOGETHER if source.is_dir() else (".ply",)
    beside = [child for child in sorted(folder.iterdir()) if child.suffix.lower() in suffixes]
    return [*beside, *([] if source.is_dir() else [source])]


def _reader(path: Path) -> tuple[ModuleType, Path]:
    """(the format's module, what it reads)."""
    for row in CAMERA_FILES:
        module = importlib.import_module(f"stages.cameras.{row.module}")
        if row.suffix:
            located = path if path.suffix.lower() == row.suffix else None
        else:
            located = module.locate(path)
        if located is not None:
            return module, located
    hint = "Check the path; a run's cameras are written by `splat cameras RUN OUT`."
    if path.suffix.lower() == ".geojson":
        hint = "For ODM's cameras, name opensfm/reconstruction.json of its project."
    raise UsageError(
        "cameras-unknown",
        given=f"{path} is not a known camera file.",
        wanted=f"{'; or '.join(row.description for row in CAMERA_FILES)}.",
        hint=hint,
    )
