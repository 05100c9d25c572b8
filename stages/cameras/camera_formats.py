"""The camera files of other programs that can be read, in one list.

To add one:

1. Write a module here with `read(path)`, which returns a `CameraFile` made by
   `camera_file.camera_file`, and `locate(path)`, which returns the path to read, or None if `path`
   is not such a file. A format that its suffix identifies needs no `locate`.
2. Give it `read_points(path)` if the file has sparse points, and `files(path)` if other files than
   the .ply beside it, or those of the folder, are read with it.
3. Add a row to `CAMERA_FILES`; the first format that locates a file reads it.
4. Add a writer to `tests/cameras/drawn.py`: the tests run over all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stages.base.errors import UsageError
from stages.cameras import (
    arkit,
    blender,
    bundler,
    colmap,
    inria,
    llff,
    metashape,
    nerfstudio,
    opensfm,
    opf,
    realityscan,
    realityscan_xmp,
)
from stages.cameras.camera_file import CameraFile, FilePoints


@dataclass(frozen=True)
class CameraFormat:
    """A row of the list.

    Attributes:
        description: for errors and help.
        locate: (path) -> the path to read, or None for another format.
        read: (what was located) -> its cameras.
        read_points: (the same) -> its sparse points; None for a format that has none.
        files: (the same) -> all files that are read; None for the usual ones.
    """

    description: str
    locate: Callable[[Path], Path | None]
    read: Callable[[Path], CameraFile]
    read_points: Callable[[Path], FilePoints | None] | None = None
    files: Callable[[Path], list[Path]] | None = None


def _suffixed(suffix: str) -> Callable[[Path], Path | None]:
    return lambda path: path if path.suffix.lower() == suffix else None


CAMERA_FILES = (
    CameraFormat(
        "cameras.json of the reference 3DGS trainer", inria.locate, inria.read, inria.read_points
    ),
    CameraFormat(
        "OpenSfM's and ODM's reconstruction.json", opensfm.locate, opensfm.read, opensfm.read_points
    ),
    CameraFormat(
        "a folder with ARKit's frame_*.json, or Polycam's keyframes", arkit.locate, arkit.read
    ),
    CameraFormat(
        "a transforms.json of nerfstudio's or instant-ngp's",
        *(_suffixed(".json"), nerfstudio.read, nerfstudio.read_points, nerfstudio.files),
    ),
    CameraFormat(
        "a folder with a synthetic NeRF scene's transforms_train.json",
        *(blender.locate, blender.read, blender.read_points),
    ),
    CameraFormat(
        "a folder with COLMAP's images.bin or images.txt",
        *(colmap.locate, colmap.read, colmap.read_points, colmap.files),
    ),
    CameraFormat("LLFF's poses_bounds.npy", llff.locate, llff.read),
    CameraFormat(
        "Bundler's .out",
        *(_suffixed(".out"), bundler.read, bundler.read_points, bundler.files),
    ),
    CameraFormat("Metashape's cameras as .xml", _suffixed(".xml"), metashape.read),
    CameraFormat("RealityScan's camera parameters as .csv", _suffixed(".csv"), realityscan.read),
    CameraFormat(
        "a folder with RealityScan's .xmp beside the photographs",
        *(realityscan_xmp.locate, realityscan_xmp.read),
    ),
    CameraFormat("Pix4D's project.opf", opf.locate, opf.read, files=opf.files),
)
_READ_TOGETHER = (".json", ".bin", ".txt", ".npy", ".ply", ".xmp")  # in a folder of cameras


def read_cameras(path: Path) -> CameraFile:
    """The cameras of a file of any listed format. Raises SplatError "cameras-unknown" or
    "cameras-unreadable"."""
    row, source = _located(path)
    return row.read(source)


def read_points(path: Path) -> FilePoints | None:
    """The sparse points of the file, if it has any. Raises as `read_cameras`."""
    row, source = _located(path)
    return row.read_points(source) if row.read_points else None


def files_of(path: Path) -> list[Path]:
    """All files that the cameras are read from. Raises SplatError."""
    row, source = _located(path)
    if row.files:
        return row.files(source)
    folder = source if source.is_dir() else source.parent
    suffixes = _READ_TOGETHER if source.is_dir() else (".ply",)
    beside = [child for child in sorted(folder.iterdir()) if child.suffix.lower() in suffixes]
    return [*beside, *([] if source.is_dir() else [source])]


def _located(path: Path) -> tuple[CameraFormat, Path]:
    """(the format, what it reads)."""
    for row in CAMERA_FILES:
        if located := row.locate(path):
            return row, located
    hint = "Check the path; a run's cameras are written by `splat cameras RUN OUT`."
    if path.suffix.lower() == ".geojson":
        hint = "For ODM's cameras, name opensfm/reconstruction.json of its project."
    raise UsageError(
        "cameras-unknown",
        given=f"{path} is not a known camera file.",
        wanted=f"{'; or '.join(row.description for row in CAMERA_FILES)}.",
        hint=hint,
    )
