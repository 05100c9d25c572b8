"""The splats and cameras that commands look at: of a run or of a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcli.folders import find_run_folder
from splatcli.viewpoints import views_of
from stages.base.errors import Family, SplatError
from stages.run import runfolder
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.scene import Splats, View

_STAGES_WITH_SPLATS = ("quantise", "prune", "train", "seed")
_STAGES_OF_SPLATS = ("sfm", *reversed(_STAGES_WITH_SPLATS))  # as they run


def splats_of(target: Path | None, strict: bool = True) -> tuple[Splats, Pipeline | None]:
    """(splats, the pipeline if `target` is a run): from a file, or a run's newest stage. strict:
    whether a value that is not finite makes a file unreadable."""
    if target is not None and target.is_file():
        from stages.formats import read

        return _as_in_its_run(target, read(target, strict=strict)), None
    if target is not None and not target.exists():
        raise SplatError(
            "file-missing",
            given=f"{target} does not exist.",
            wanted="A run folder or a splat file.",
            hint="Check the path.",
        )
    pipeline = Pipeline(find_run_folder(target))
    name = newest_with_splats(pipeline)
    output = pipeline.load(name)
    return (output.splats if name in ("train", "quantise") else output), pipeline


def _as_in_its_run(file: Path, splats: Splats) -> Splats:
    """A file says nothing of how it is drawn; the run whose export folder it lies in does."""
    from stages.scene import draw_settings_of

    views = views_around(file)
    return replace(splats, draw_settings=draw_settings_of(tuple(views))) if views else splats


def backend_of(pipeline: Pipeline | None) -> str:
    """The backend that a run was trained with, as it was asked for; "auto" without a run, and on a
    machine that cannot run it."""
    from stages.raster.backends import AUTO, backend_of_settings, runs_here

    asked = AUTO if pipeline is None else backend_of_settings(pipeline.recorded_settings()["train"])
    return asked if runs_here(asked) else AUTO


def newest_with_splats(pipeline: Pipeline) -> str:
    """The last finished stage whose output is splats. Raises SplatError (no-splats-yet)."""
    for name in _STAGES_WITH_SPLATS:
        if pipeline.manifest(name) is not None:
            return name
    raise SplatError(
        "no-splats-yet",
        given=f"No stage of {pipeline.run_folder} has made splats yet.",
        wanted="A run in which at least `seed` has finished.",
        hint="Run `splat process` to go on.",
        family=Family.USAGE,
    )


def finished_splats(pipeline: Pipeline) -> Splats:
    """A run's last splats, where all that they were made from is still what lies there.

    Raises SplatError (stage-not-finished, run-half-anew)."""
    made: dict[str, Manifest] = {}
    for name in _STAGES_OF_SPLATS:
        manifest = pipeline.manifest(name)
        if manifest is None:
            pipeline.load(name)  # which says so
            raise AssertionError(name)
        for source, before in made.items():
            if manifest.inputs.get(source, before.output_digest) != before.output_digest:
                raise SplatError(
                    "run-half-anew",
                    given=f"In {pipeline.run_folder}, {source} was made again, and {name} was not.",
                    wanted="A run whose stages belong together.",
                    hint="Run `splat process` to finish it.",
                    family=Family.USAGE,
                )
        made[name] = manifest
    splats: Splats = pipeline.load("quantise").splats
    return splats


def exported_formats(pipeline: Pipeline) -> dict[str, dict[str, Any]]:
    """Figures of each file that a run's last splats were written to, by format; none where export
    has not finished, or wrote others."""
    quantised, exported = pipeline.manifest("quantise"), pipeline.manifest("export")
    if quantised is None or exported is None:
        return {}
    if exported.inputs.get("quantise") != quantised.output_digest:
        return {}
    return dict(exported.metrics.get("formats", {}))


def pipeline_around(file: Path | None) -> Pipeline | None:
    """The run whose export folder a file lies in: its cameras fit the file."""
    if file is None or not runfolder.is_run_folder(file.absolute().parent.parent):
        return None
    return Pipeline(file.absolute().parent.parent)


def views_around(file: Path | None) -> tuple[View, ...]:
    """Those of the run whose export folder a file lies in; none elsewhere."""
    return views_of(pipeline_around(file))
