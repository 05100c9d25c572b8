"""QuantisedSplats -> files that other programs open, each one checked before it counts.

Every file is read back by a parser that did not write it, drawn from cameras of the capture, and
compared with the splats that it was made from. A file that came out wrong stops the export.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.run.errors import Family, SplatError
from stages.run.stage import Report, Stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stages.scene import Camera, ExportedAssets, QuantisedSplats, Reconstruction, Splats

FORMATS = (
    *("ply", "splat", "glb", "gltf", "usda", "usdc", "usdz"),
    *("compressed.ply", "spz", "sog", "html"),
)
# What `--format` says -> the files that it stands for. They hold triangles: no splat reader's.
MESHES = {
    "mesh": ("mesh.glb", "mesh.ply"),
    "mesh.glb": ("mesh.glb",),
    "mesh.ply": ("mesh.ply",),
}
_LOSSES = {
    "splat": "has 8-bit colours that do not change with the view",
    "compressed.ply": "has positions and sizes of 10 and 11 bits, and 8-bit colours",
    "spz": "has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
    "sog": "has 256 sizes and colours, and a palette of view-dependent colours",
}
_INDEX = "assets.json"
_CHECK_SIDE_PX = 480
_CHECK_CAMERAS = 3
_CAP_DB = 99.0  # what "no difference at all" is written as: JSON has no infinity
_LOSSLESS_DB = 45.0  # below it a file that should hold everything is wrong
_LOSSY_DB = 30.0  # below it the loss is worth a warning


@dataclass(frozen=True)
class ExportSettings:
    """Settings of the export."""

    formats: tuple[str, ...] = field(
        default=("ply", "splat", "glb", "usdz"),
        metadata={
            "help": "File format to write; repeatable. mesh is a collision proxy, as .glb and .ply",
            "choices": (*FORMATS, *MESHES),
        },
    )
    name: str = field(default="scene", metadata={"help": "Name of the files, without a suffix."})
    backend: str = field(
        default="auto",
        metadata={
            "help": "What draws the files for checking: auto, cpu or reference.",
            "choices": ("auto", "cpu", "reference"),
        },
    )
    mesh_triangles: int = field(
        default=50_000, metadata={"help": "Triangles of the mesh, at most about.", "min": 100}
    )


def check(settings: ExportSettings) -> None:
    """Raises SplatError for a format that is not written, and for a name that cannot be one."""
    unknown = [name for name in settings.formats if name not in (*FORMATS, *MESHES)]
    if unknown or not settings.formats:
        raise SplatError(
            "export-format-unknown",
            given=f"Asked to export {', '.join(unknown) or 'no format at all'}.",
            wanted=f"One or more of {', '.join((*FORMATS, *MESHES))}.",
            hint="Name each with --format, for example: splat export --format glb --format usdz",
            family=Family.USAGE,
        )
    # Every system must take the name, USD's packages too: brackets separate names inside them.
    good = re.fullmatch(r"[^/\\:*?\"<>|\[\]\x00-\x1f]{1,100}", settings.name)
    if not good or settings.name != settings.name.strip(" .") or settings.name == "assets":
        raise SplatError(
            "export-name",
            given=f"The name {settings.name!r} cannot be a file's name on every system.",
            wanted="Letters, digits, spaces, - and _; no folder, no suffix.",
            hint="Choose another --name.",
            family=Family.USAGE,
        )


def run(
    inputs: Mapping[str, Any], settings: ExportSettings, folder: Path, report: Report
) -> ExportedAssets:
    """Write inputs["quantise"] in all formats into `folder`, seen by the views of inputs["sfm"].

    Metrics: files (how many), splats, dropped, formats: by format size_bytes, bytes_per_splat,
    verify_db (PSNR between pictures of the splats and of the file, the worst camera) and the
    largest errors of the values; mesh: see `surface.make`. Raises SplatError
    "export-verify-failed" (family QUALITY), and what keeps a file from being written.
    """
    from stages import formats
    from stages.formats.rows import kept_rows
    from stages.scene import ExportedAssets, ExportedFile

    check(settings)
    quantised: QuantisedSplats = inputs["quantise"]
    reconstruction: Reconstruction = inputs["sfm"]
    _clear(folder)
    splats, dropped = kept_rows(quantised.splats)
    if not splats.origin.any():
        splats = replace(splats, origin=reconstruction.origin)
    _say_what_is_missing(len(splats), dropped, report)
    wanted = tuple(name for name in dict.fromkeys(settings.formats) if name in FORMATS)
    checker = _Checker.of(splats, reconstruction, settings.backend)
    files, figures = [], {}
    for number, name in enumerate(wanted):
        report.progress(number, len(wanted), f"writing .{name}")
        path = folder / f"{settings.name}.{name}"
        formats.write(path, splats, units=reconstruction.units, views=reconstruction.views)
        size = path.stat().st_size
        if name == "gltf":
            size += path.with_suffix(".bin").stat().st_size if len(splats) else 0
        files.append(ExportedFile(name, path.name, size))
        figures[name] = {
            "size_bytes": size,
            "bytes_per_splat": round(size / max(1, len(splats)), 2),
            **checker.check(path, name, report),
        }
        report.progress(number + 1, len(wanted), f".{name}", verify_db=figures[name]["verify_db"])
    for name, path, size in _write_meshes(splats, reconstruction, settings, folder, report):
        files.append(ExportedFile(name, path.name, size))
        figures[name] = {"size_bytes": size}
    report.metric("files", len(files))
    report.metric("splats", len(splats))
    report.metric("dropped", dropped)
    report.metric("formats", figures)
    _write_index(folder, files)
    return ExportedAssets(folder, tuple(files))


def _write_meshes(
    splats: Splats,
    reconstruction: Reconstruction,
    settings: ExportSettings,
    folder: Path,
    report: Report,
) -> list[tuple[str, Path, int]]:
    """(format, path, bytes) of each mesh asked for; metric: mesh, see `surface.make`."""
    wanted = dict.fromkeys(file for name in settings.formats for file in MESHES.get(name, ()))
    if not wanted:
        return []
    from stages.surface.files import write_meshes
    from stages.surface.make import make

    made = make(splats, reconstruction, settings.mesh_triangles, settings.backend, report)
    report.metric("mesh", made.figures)
    return write_meshes(folder, settings.name, wanted, made.mesh, reconstruction.units)


def _clear(folder: Path) -> None:
    """Remove what a writer that was killed left half done; whole files are written over."""
    import shutil

    for path in sorted(folder.glob(".partial-*")):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _say_what_is_missing(count: int, dropped: int, report: Report) -> None:
    if dropped:
        report.warn(
            "export-splats-dropped",
            f"{dropped} splats hold values that no viewer can draw and were left out; "
            "if they are many, train again with another seed.",
        )
    if not count:
        report.warn(
            "export-empty", "There is not one splat to export; look at the earlier stages' figures."
        )


def _write_index(folder: Path, files: list[Any]) -> None:
    entries = [
        {"format": file.format, "path": file.path, "size_bytes": file.size_bytes} for file in files
    ]
    (folder / _INDEX).write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class _Checker:
    """Compares files with the splats that they were made from."""

    splats: Splats
    cameras: tuple[Camera, ...]
    pictures: tuple[NDArray[np.float32], ...]
    backend: str

    @classmethod
    def of(cls, splats: Splats, reconstruction: Reconstruction, backend: str) -> _Checker:
        from stages.raster import render
        from stages.scene import split_held_out

        training, held = split_held_out(reconstruction.views)
        views = held or training
        count = min(_CHECK_CAMERAS, len(views))
        chosen = [views[i * len(views) // count] for i in range(count)]
        cameras = tuple(view.camera.fitted(_CHECK_SIDE_PX) for view in chosen)
        pictures = tuple(render(splats, camera, backend=backend).image for camera in cameras)
        return cls(splats, cameras, pictures, backend)

    def check(self, path: Path, name: str, report: Report) -> dict[str, float]:
        """The file's figures. Raises SplatError "export-verify-failed"."""
        from stages.formats.compare import largest_errors
        from stages.formats.verify import read_back

        try:
            content = read_back(path)
        except Exception as error:  # whatever another parser raises: the file is wrong
            raise _failed(path, f"another reader refused it ({error})") from error
        if len(content.splats) != len(self.splats):
            raise _failed(path, f"it holds {len(content.splats)} of {len(self.splats)} splats")
        worst = self._worst_db(content)
        if name in _LOSSES:
            if worst < _LOSSY_DB:
                report.warn(
                    f"export-{name.replace('.', '-')}-lossy",
                    f"{path.name} differs from the trained splats by {worst:.1f} dB: the format "
                    f"{_LOSSES[name]}. Where a viewer reads them, prefer .ply, .glb or .usdz.",
                )
        elif worst < _LOSSLESS_DB:
            raise _failed(path, f"drawn again it differs by {worst:.1f} dB")
        return {"verify_db": round(worst, 2), **largest_errors(self.splats, content, name)}

    def _worst_db(self, content: Any) -> float:
        """The camera is moved into the file's axes, not the file's splats into ours: so the turn
        of positions, rotations and SH is checked by something other than itself."""
        from stages.measure.images import psnr
        from stages.raster import render

        worst = _CAP_DB
        for camera, picture in zip(self.cameras, self.pictures, strict=True):
            moved = camera.moved(content.world_from_file)
            drawn = render(content.splats, moved, backend=self.backend).image
            decibels = psnr(drawn, picture)
            worst = min(worst, 0.0 if math.isnan(decibels) else decibels)
        return worst


def _failed(path: Path, reason: str) -> SplatError:
    return SplatError(
        "export-verify-failed",
        given=f"{path.name} came out wrong: {reason}.",
        wanted="A file that another program reads as the same splats.",
        hint="Leave this format out with --format, and report this with the run's manifest.",
        family=Family.QUALITY,
    )


def load(folder: Path) -> ExportedAssets:
    """The files of a finished folder. Raises SplatError if its index is damaged."""
    from stages.scene import ExportedAssets, ExportedFile

    try:
        entries = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        files = tuple(
            ExportedFile(str(e["format"]), str(e["path"]), int(e["size_bytes"])) for e in entries
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatError(
            "export-folder-damaged",
            given=f"{folder / _INDEX} cannot be read: {error}.",
            wanted="The list of files that the stage wrote.",
            hint="Run `splat export` again.",
            family=Family.RUN_FOLDER,
        ) from error
    return ExportedAssets(folder, files)


STAGE = Stage(
    name="export",
    version=1,
    reads=("sfm", "quantise"),
    settings_type=ExportSettings,
    run=run,
    load=load,
)
