"""`splat tradeoff`: quality against time, bytes and number of splats for one run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from splatcli import console
from splatcli.arguments import Run
from splatcli.folders import find_run_folder
from stages.base.atomic import make_folder
from stages.base.errors import UsageError
from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views
from stages.prune.stage import pruner_of
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.scene import Splats, evenly_spaced, split_held_out, why_none_is_held_out
from stages.tradeoff.intervals import TRAINING_VIEWS
from stages.tradeoff.measurement import TradeoffInputs, measure_tradeoff
from stages.tradeoff.report import summarise, write_report


def tradeoff(
    run: Run = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="Folder for the report.",
            show_default="RUN/tradeoff",
        ),
    ] = None,
) -> None:
    """Measure quality against time, bytes and number of splats: a report with plots.

    The quality is measured on held-out views. The course of training comes from its log, files are
    really written and read, and the trained splats are pruned to several numbers, as `splat prune
    --max-splats` does.
    """
    pipeline = Pipeline(find_run_folder(run))
    inputs = _inputs(pipeline)
    folder = out or pipeline.run_folder / "tradeoff"
    make_folder(folder)
    console.note_compiling()
    result = measure_tradeoff(inputs, console.step)
    files = write_report(folder, pipeline.run_folder.absolute().name, result, inputs)
    if console.mode.as_json:
        console.emit(
            "tradeoff", folder=str(folder), files=[str(f) for f in files], summary=summarise(result)
        )
        return
    if not console.mode.quiet:
        for title, lines in summarise(result).items():
            for number, line in enumerate(lines):
                console.out.print(f"{title if not number else '':<12} {line}", markup=False)
    console.out.print(str(files[0]), markup=False)


def _nothing_held_out(given: str, hint: str) -> UsageError:
    wanted = "A run with photographs that training did not use, to measure quality on."
    return UsageError("nothing-held-out", given=given, wanted=wanted, hint=hint)


def _inputs(pipeline: Pipeline) -> TradeoffInputs:
    """The splats, views and files to measure, of a finished run. Raises SplatError
    (stage-not-finished, run-half-anew, nothing-held-out)."""
    splats = results.final_splats(pipeline)
    settings = splats.draw_settings
    reconstruction = results.reconstruction_of(pipeline)
    training, held = split_held_out(reconstruction.views)
    if not held:
        raise _nothing_held_out(
            f"{pipeline.run_folder} has no held-out view: "
            f"{why_none_is_held_out(reconstruction.views)}.",
            "Use a run of four photographs or more, without --no-hold-out.",
        )
    held_out = load_evaluation_views(reconstruction.folder, held, settings)
    if not any(view.counts for view in held_out):
        raise _nothing_held_out(
            f"Masks leave nothing of the held-out photographs of {pipeline.run_folder}.",
            "Make the run again with masks that leave more, or without --masks.",
        )
    manifest = pipeline.manifest("train")
    views = load_evaluation_views(reconstruction.folder, training, settings)
    backend, report = results.backend_of_run(pipeline), Report()
    trained = pipeline.load("train")
    pruning = replace(pipeline.recorded_settings()["prune"], max_mb=0.0, min_psnr=0.0, seconds=0.0)

    def prune_to(splats: Splats, count: int) -> Splats:
        wanted = replace(pruning, max_splats=count)
        return (
            pruner_of(wanted, reconstruction, trained, views, backend, report).prune(splats).splats
        )

    return TradeoffInputs(
        splats=splats,
        held_out=held_out,
        training=evenly_spaced(views, TRAINING_VIEWS),
        views=reconstruction.views,
        units=reconstruction.units,
        backend=backend,
        history=manifest.metrics.get("history", ()) if manifest else (),
        exported=tuple(results.exported_formats(pipeline)),
        quantised=pipeline.load("quantise"),
        prune_to=prune_to,
        trained=trained.splats,
    )
