"""`splat cameras`: writes cameras in the format of nerfstudio or of COLMAP."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console
from stages.base.atomic import make_folder
from stages.base.errors import SplatError, UsageError
from stages.cameras import colmap, nerfstudio
from stages.cameras.camera_file import NO_POINTS, CameraFile, FilePoints
from stages.cameras.camera_formats import read_cameras, read_points
from stages.run import runfolder
from stages.run.pipeline import Pipeline


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
    written with them. nerfstudio's world is z up, also that of a transforms.json without
    applied_transform; COLMAP's is y down, as in a run. Other sources are taken to be y down.
    """
    to_nerfstudio = _is_json(out)
    source = _model_of_run(source) if runfolder.is_run_folder(source) else source
    model = colmap.locate(source)
    _check_other(out, source if model is None else model)
    found, cloud, observations = colmap.read_model(model) if model else _read(source)
    if found.distorted:
        raise SplatError(
            "cameras-distorted",
            given=f"The lenses of {found.distorted} of {len(found.views)} cameras distort.",
            wanted="Pinhole cameras: other ones would not fit their photographs.",
            hint="Undistort the photographs first, or make a run of them with `splat process`.",
        )
    pictures = found.folder
    if to_nerfstudio:
        nerfstudio.write(out, found.views, pictures, cloud.points, cloud.colours)
    else:
        names = [view.name for view in found.views]
        if model is None:
            names, pictures = _names_in_one_folder(found)
        make_folder(out)
        cameras = [view.camera for view in found.views]
        colmap.write_model(out, names, cameras, cloud, observations)
    facts = {
        "out": str(out),
        "cameras": len(found.views),
        "points": len(cloud.points),
        "pictures": str(pictures),
        "pictures_found": (found.folder / found.views[0].image).is_file(),
    }
    _print(facts)


def _read(source: Path) -> tuple[CameraFile, FilePoints, colmap.Observations]:
    """(cameras, points, no observations) of a file; a world that is z up is turned y down."""
    found, cloud = read_cameras(source), read_points(source) or NO_POINTS
    if found.z_up:
        views, points = nerfstudio.y_down(found.views, cloud.points)
        found, cloud = replace(found, views=views), replace(cloud, points=points)
    return found, cloud, colmap.NO_OBSERVATIONS


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


def _check_other(out: Path, source: Path) -> None:
    """Raise SplatError where cameras would be written onto those that are read: what only the
    source holds, as its roles and units, would be lost."""
    read = nerfstudio.files(source) if source.suffix.lower() == ".json" else [source]
    for target in (out, nerfstudio.points_beside(out)):
        if target.exists() and any(file.exists() and target.samefile(file) for file in read):
            raise UsageError(
                "target-is-source",
                given=f"{target} is what is read.",
                wanted="Another name.",
                hint=f"For example {out.with_name('new-' + out.name)}",
            )


def _model_of_run(run: Path) -> Path:
    pipeline = Pipeline(run)
    if pipeline.manifest("sfm") is None:
        raise UsageError(
            "no-cameras-yet",
            given=f"No cameras of {run} have been found yet.",
            wanted="A run in which `sfm` has finished.",
            hint="Run `splat process` to go on.",
        )
    pipeline.check_outputs(("sfm",), pictures=False)
    return pipeline.stage_folder("sfm") / "colmap"


def _names_in_one_folder(found: CameraFile) -> tuple[list[str], Path]:
    """(names of the pictures, the innermost folder that holds all of them)."""
    paths = [os.path.normpath(found.folder / view.image) for view in found.views]
    root = os.path.commonpath([os.path.dirname(path) for path in paths])
    return [Path(path).relative_to(root).as_posix() for path in paths], Path(root)
