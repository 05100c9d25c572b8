"""The splats, cameras and figures that a run folder holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.base.errors import UsageError
from stages.base.text import quoted
from stages.formats import read
from stages.raster.backends import AUTO, runs_here
from stages.run import runfolder
from stages.run.pipeline import Pipeline
from stages.scene import (
    DrawSettings,
    Reconstruction,
    Splats,
    TrainedSplats,
    View,
    draw_settings_of,
)

_STAGES_WITH_SPLATS = ("seed", "train", "prune", "quantise")


def out_of_date(pipeline: Pipeline) -> dict[str, str]:
    """The finished stages that were not made from what the run folder holds now, each with the
    stage that was made again since. Raises SplatError for a damaged manifest."""
    stale: dict[str, str] = {}
    digests: dict[str, str] = {}
    for stage in pipeline.layout.stages:
        manifest = pipeline.manifest(stage.name)
        if manifest is None:
            continue
        for source in stage.reads:
            if source in stale:
                stale.setdefault(stage.name, stale[source])
            elif manifest.inputs.get(source) != digests.get(source, manifest.inputs.get(source)):
                stale.setdefault(stage.name, source)
        digests[stage.name] = manifest.output_digest
    return stale


def newest_stage_with_splats(pipeline: Pipeline) -> str:
    """The last finished stage whose output is splats and is not out of date. Raises SplatError
    (no-splats-yet)."""
    stale = out_of_date(pipeline)
    for name in reversed(_STAGES_WITH_SPLATS):
        if name not in stale and pipeline.manifest(name) is not None:
            return name
    raise UsageError(
        "no-splats-yet",
        given=f"No stage of {pipeline.run_folder} has made splats yet"
        + "".join(f" from its present {source}" for source in [*stale.values()][:1])
        + ".",
        wanted="A run in which at least `seed` has finished.",
        hint="Run `splat process` to go on.",
    )


def newest_splats(pipeline: Pipeline, antialias: bool = True) -> Splats:
    """The splats of `newest_stage_with_splats`.

    Args:
        pipeline: of the run.
        antialias: whether splats for antialiased drawing are accepted; else those for plain drawing
            are returned, if the run made them.

    Raises SplatError (no-splats-yet).
    """
    name = newest_stage_with_splats(pipeline)
    output = pipeline.load(name)
    if name == "quantise" and not antialias and output.plain is not None:
        output = replace(output, splats=output.plain)
    splats: Splats = output if name == "seed" else output.splats
    if pipeline.manifest("sfm") is None:
        return splats
    return replace(splats, place=pipeline.load("sfm").place)


def reconstruction_of(pipeline: Pipeline) -> Reconstruction:
    """The capture, with the cameras and masks of training where it has finished. Raises SplatError
    (stage-not-finished)."""
    reconstruction: Reconstruction = pipeline.load("sfm")
    if not _is_trained(pipeline):
        return reconstruction
    trained: TrainedSplats = pipeline.load("train")
    return reconstruction.with_cameras(trained.cameras).with_masks(trained.masks)


def final_splats(pipeline: Pipeline) -> Splats:
    """The splats of a finished run, whose stages were made from each other as they lie there.

    Raises SplatError (stage-not-finished, run-half-anew, run-folder-damaged).
    """
    pipeline.check_outputs()  # the caller reads pictures, too
    stale = out_of_date(pipeline)
    for name in ("sfm", *_STAGES_WITH_SPLATS):
        if pipeline.manifest(name) is None:
            pipeline.load(name)  # raises stage-not-finished
        if name in stale:
            raise UsageError(
                "run-half-anew",
                given=f"In {pipeline.run_folder}, {stale[name]} was made again, and {name} was "
                "not.",
                wanted="A run whose stages belong together.",
                hint=f"Run `splat process {quoted(pipeline.run_folder)}` to finish it.",
            )
    splats: Splats = pipeline.load("quantise").splats
    return splats


def exported_formats(pipeline: Pipeline) -> dict[str, dict[str, Any]]:
    """The figures of each exported file by format; empty if export has not finished, or is out
    of date."""
    exported = pipeline.manifest("export")
    if exported is None or "export" in out_of_date(pipeline):
        return {}
    return dict(exported.metrics.get("formats", {}))


def views_of(pipeline: Pipeline | None) -> tuple[View, ...]:
    """The capture's views, as training has refined them, sorted by name; empty without a finished
    reconstruction."""
    if pipeline is None or pipeline.manifest("sfm") is None:
        return ()
    return tuple(sorted(reconstruction_of(pipeline).views, key=lambda view: view.name))


def training_side_of(pipeline: Pipeline | None) -> int:
    """Longer side of the largest held-out picture at the size of training, pixels; 0 if unknown."""
    trained = pipeline.manifest("train") if pipeline is not None else None
    return int(trained.metrics.get("evaluated_side_px", 0)) if trained is not None else 0


def run_around(file: Path | None) -> Pipeline | None:
    """The run whose export folder a file lies in: its cameras fit the file."""
    if file is None or not runfolder.is_run_folder(file.absolute().parent.parent):
        return None
    run = Pipeline(file.absolute().parent.parent)
    return run if file.absolute().parent == run.stage_folder("export").absolute() else None


def read_file(file: Path, strict: bool = True) -> Splats:
    """The splats of a file. A file in a run's export folder gets that run's draw settings.

    strict: whether a value that is not finite makes the file unreadable. Raises SplatError.
    """
    splats = read(file, strict=strict)
    run = run_around(file)
    if run is None or run.manifest("sfm") is None:
        return splats
    settings = _draw_settings_in(run)
    antialias = splats.draw_settings.antialias  # as the file says
    return replace(splats, draw_settings=replace(settings, antialias=antialias))


def _draw_settings_in(pipeline: Pipeline) -> DrawSettings:
    """Those of training, with its size and correction of light; before it, those of the capture."""
    if _is_trained(pipeline):
        trained: TrainedSplats = pipeline.load("train")
        return trained.splats.draw_settings
    return draw_settings_of(pipeline.load("sfm"))


def _is_trained(pipeline: Pipeline) -> bool:
    """Whether training has finished with what the run folder holds now."""
    return pipeline.manifest("train") is not None and "train" not in out_of_date(pipeline)


def backend_of_run(pipeline: Pipeline | None) -> str:
    """The backend that was requested for training the run; "auto" without a run, and on a machine
    that cannot use that backend."""
    if pipeline is None:
        return AUTO
    requested: str = pipeline.recorded_settings()["train"].backend
    return requested if runs_here(requested) else AUTO
