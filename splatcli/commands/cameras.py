"""`splat cameras`: writes cameras in the format of nerfstudio or of COLMAP."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splatcli import console
from stages.base.atomic import make_folder
from stages.base.errors import SplatError, UsageError
from stages.run import runfolder
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.cameras.camera_file import CameraFile
    from stages.cameras.colmap import ColmapModel


def cameras(
    source: Annotated[
        Path, typer.Argument(help="Run folder, transforms.json, or folder with a COLMAP model.")
    ],
    out: Annotated[
        Path, typer.Argument(help="A .json name for nerfstudio, or a folder for COLMAP.")
    ],
) -> None:
    """Write cameras for other programs: those of a run, of nerfstudio or of COLMAP.

    A run's cameras belong to its undistorted photographs, which the file names; sparse points are
    written with them. nerfstudio's world is z up; COLMAP's is y down, as in a run.
    """
    from stages.cameras import colmap, nerfstudio

    to_nerfstudio = _is_json(out)
    found, model = _read(source)
    if found.distorted:
        raise SplatError(
            "cameras-distorted",
            given=f"The lenses of {found.distorted} of {len(found.views)} cameras distort.",
            wanted="Pinhole cameras: other ones would not fit their photographs.",
            hint="Undistort the photographs first, or make a run of them with `splat process`.",
        )
    pictures = found.folder
    if to_nerfstudio:
        points = (model.points, model.colours) if model is not None else (None, None)
        nerfstudio.write(out, found.views, pictures, *points)
    else:
        if model is None:
            model, pictures = _without_points(found)
        make_folder(out)
        colmap.write_colmap_model(out, model)
    facts = {
        "out": str(out),
        "cameras": len(found.views),
        "points": len(model.points) if model is not None else 0,
        "pictures": str(pictures),
        "pictures_found": (found.folder / found.views[0].image).is_file(),
    }
    _print(facts)


def _print(facts: dict[str, Any]) -> None:
    if console.mode.as_json:
        console.emit("cameras", **facts)
        return
    points = f", {facts['points']:,} points" if facts["points"] else ""
    console.note(f"{facts['out']}: {facts['cameras']} cameras{points}")
    if facts["pictures_found"]:
        console.note(f"Their pictures are in {facts['pictures']}")
    else:
        console.warn(f"Warning: their pictures are not in {facts['pictures']}.")


def _is_json(out: Path) -> bool:
    if out.suffix.lower() == ".json" and not out.is_dir():
        return True
    if out.is_dir() or (not out.suffix and not out.exists()):
        return False
    raise UsageError(
        "cameras-target",
        given=f"{out} cannot hold cameras.",
        wanted="A name that ends in .json for nerfstudio, or a folder's for COLMAP.",
        hint="For example transforms.json, or sparse",
    )


def _read(source: Path) -> tuple[CameraFile, ColmapModel | None]:
    """(the cameras, the COLMAP model with its points or None)."""
    from stages.cameras.colmap import locate, read_model
    from stages.cameras.table import read_cameras

    if runfolder.is_run_folder(source):
        pipeline = Pipeline(source)
        if pipeline.manifest("sfm") is None:
            raise UsageError(
                "no-cameras-yet",
                given=f"No cameras of {source} have been found yet.",
                wanted="A run in which `sfm` has finished.",
                hint="Run `splat process` to go on.",
            )
        source = pipeline.stage_folder("sfm") / "colmap"
    folder = locate(source)
    return (read_cameras(source), None) if folder is None else read_model(folder)


def _without_points(found: CameraFile) -> tuple[ColmapModel, Path]:
    """(a model without points, the innermost folder that holds all pictures)."""
    from stages.cameras.colmap import ColmapModel

    paths = [os.path.normpath(found.folder / view.image) for view in found.views]
    root = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = tuple(Path(path).relative_to(root).as_posix() for path in paths)
    model = ColmapModel(names, tuple(view.camera for view in found.views))
    return model, Path(root)
