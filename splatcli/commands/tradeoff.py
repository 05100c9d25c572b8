"""`splat tradeoff`: what a minute, a megabyte and a splat are worth in a run's own scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from splatcli import console, sources
from splatcli.folders import find_run_folder
from stages.base.errors import Family, SplatError
from stages.raster.kernels import cache
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.measure.tradeoff.measurement import TradeoffInputs


def tradeoff(run: Path | None, out: Path | None, quiet: bool, as_json: bool) -> None:
    """Measure, write the report into `out` (by default a folder in the run), and say the gist.

    Raises SplatError: stage-not-finished, run-half-anew, nothing-held-out, and what keeps files
    from being written."""
    from stages.base.atomic import make_folder
    from stages.measure.tradeoff.measurement import measure_tradeoff
    from stages.measure.tradeoff.report import summarise, write_report

    pipeline = Pipeline(find_run_folder(run))
    material = material_of(pipeline)
    folder = out or pipeline.run_folder / "tradeoff"
    make_folder(folder)
    if not quiet and not cache.are_compiled():
        console.note("Compiling the kernels; this is done once and takes about half a minute.")

    def tell(label: str) -> None:
        if as_json:
            console.emit("progress", label=label)
        elif not quiet:
            console.note(label)

    trade = measure_tradeoff(material, tell)
    files = write_report(folder, pipeline.run_folder.absolute().name, trade, material)
    if as_json:
        said = summarise(trade)
        console.emit("tradeoff", folder=str(folder), files=[str(f) for f in files], said=said)
        return
    if not quiet:
        for title, lines in summarise(trade).items():
            for number, line in enumerate(lines):
                console.out.print(f"{title if not number else '':<12} {line}", markup=False)
    console.out.print(str(files[0]), markup=False)


def material_of(pipeline: Pipeline) -> TradeoffInputs:
    """What is measured of a finished run. Raises SplatError (stage-not-finished, run-half-anew,
    nothing-held-out)."""
    from stages.measure.evaluation import load_evaluation_views
    from stages.measure.tradeoff.measurement import TradeoffInputs, deciding_views
    from stages.scene import split_held_out

    splats = sources.finished_splats(pipeline)
    reconstruction = pipeline.load("sfm")
    training, held = split_held_out(reconstruction.views)
    if not held:
        raise SplatError(
            "nothing-held-out",
            given=f"{pipeline.run_folder} holds no photograph out: there are too few to spare one.",
            wanted="A run with photographs that training did not see, to judge by.",
            hint="Take more photographs: four are the least; of every eight, one judges.",
            family=Family.USAGE,
        )
    trained = pipeline.manifest("train")
    exported = tuple(sources.exported_formats(pipeline))
    return TradeoffInputs(
        splats=splats,
        training=load_evaluation_views(
            reconstruction.folder,
            deciding_views(training, splats.draw_settings),
            splats.draw_settings,
        ),
        held_out=load_evaluation_views(reconstruction.folder, held, splats.draw_settings),
        views=reconstruction.views,
        units=reconstruction.units,
        backend=sources.backend_of(pipeline),
        levelled=reconstruction.levelled,
        history=trained.metrics.get("history", ()) if trained else (),
        exported=exported,
        quantised=pipeline.load("quantise"),
    )
