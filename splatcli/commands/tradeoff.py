"""`splat tradeoff`: quality against time, bytes and number of splats for one run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splatcli import console
from splatcli.arguments import Run
from splatcli.folders import find_run_folder
from stages.base.errors import UsageError
from stages.run import results
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.measure.tradeoff.measurement import TradeoffInputs


def tradeoff(
    run: Run = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the report.", show_default="RUN/tradeoff"),
    ] = None,
) -> None:
    """Measure quality against time, bytes and number of splats: a report with plots.

    The quality is measured on held-out views. The course of training comes from its log, files are
    really written and read, splats are removed in the order of what they contribute and the rest
    fine-tuned, as `splat prune` does.
    """
    from stages.base.atomic import make_folder
    from stages.measure.tradeoff.measurement import measure_tradeoff
    from stages.measure.tradeoff.report import summarise, write_report

    pipeline = Pipeline(find_run_folder(run))
    inputs = _inputs(pipeline)
    folder = out or pipeline.run_folder / "tradeoff"
    make_folder(folder)
    console.note_compiling()
    found = measure_tradeoff(inputs, console.step)
    files = write_report(folder, pipeline.run_folder.absolute().name, found, inputs)
    if console.mode.as_json:
        console.emit(
            "tradeoff", folder=str(folder), files=[str(f) for f in files], summary=summarise(found)
        )
        return
    if not console.mode.quiet:
        for title, lines in summarise(found).items():
            for number, line in enumerate(lines):
                console.out.print(f"{title if not number else '':<12} {line}", markup=False)
    console.out.print(str(files[0]), markup=False)


def _inputs(pipeline: Pipeline) -> TradeoffInputs:
    """The splats, views and files to measure, of a finished run. Raises SplatError
    (stage-not-finished, run-half-anew, nothing-held-out)."""
    from stages.base.stage import Report
    from stages.measure.evaluation import load_evaluation_views
    from stages.measure.tradeoff.measurement import SHARES, TradeoffInputs, deciding_views
    from stages.scene import split_held_out, training_extent
    from stages.training.finetune import FineTuner

    splats = results.final_splats(pipeline)
    settings = splats.draw_settings
    reconstruction = pipeline.load("sfm")
    training, held = split_held_out(reconstruction.views)
    if not held:
        raise UsageError(
            "nothing-held-out",
            given=f"{pipeline.run_folder} has no held-out view: there are too few photographs.",
            wanted="A run with photographs that training did not use, to measure quality on.",
            hint="Take more photographs: at least four; one of every eight is held out.",
        )
    trained = pipeline.manifest("train")
    views = load_evaluation_views(reconstruction.folder, training, settings)
    deciding = {view.name for view in deciding_views(training, settings)}
    backend = results.backend_of_run(pipeline)
    dropout = pipeline.load("train").dropout
    finetuner = FineTuner(views, training_extent(reconstruction), backend, Report(), dropout)
    pruning = pipeline.recorded_settings()["prune"]
    # as many steps as pruning takes, by the time that half of the splats are left
    steps = pruning.rounds * pruning.finetune_steps // sum(share >= 0.5 for share in SHARES)
    return TradeoffInputs(
        splats=splats,
        training=[view for view in views if view.name in deciding],
        held_out=load_evaluation_views(reconstruction.folder, held, settings),
        views=reconstruction.views,
        units=reconstruction.units,
        backend=backend,
        levelled=reconstruction.levelled,
        history=trained.metrics.get("history", ()) if trained else (),
        exported=tuple(results.exported_formats(pipeline)),
        quantised=pipeline.load("quantise"),
        finetune=lambda fewer, view_counts: finetuner.finetune(fewer, steps, view_counts),
    )
