"""`splat compare`: whether one of two runs of the same photographs is better."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from splatcli import console
from splatcli.folders import find_run_folder
from stages.base.atomic import make_folder
from stages.base.errors import UsageError
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.run.planning import PHOTOS
from stages.tradeoff.comparison import (
    Candidate,
    compare_runs,
    distinct_name,
    fact_rows,
    verdict_lines,
    write_comparison,
)


def compare(
    first: Annotated[Path, typer.Argument(help="Run folder.")],
    second: Annotated[Path, typer.Argument(help="Another, of the same photographs.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="PATH", help="Folder for the report.")
    ] = Path("comparison"),
) -> None:
    """Compare two runs: better, worse, or no significant difference.

    Both are evaluated at one size, view by view, on photographs that neither was trained on.
    """
    runs = [Pipeline(find_run_folder(folder)) for folder in (first, second)]
    sides = [
        _side(run, distinct_name(run.run_folder, other.run_folder))
        for run, other in zip(runs, reversed(runs), strict=True)
    ]
    _check_photographs(*runs)
    console.note_compiling()
    comparison = compare_runs(sides[0], sides[1])
    make_folder(out)
    files = write_comparison(out, comparison)
    if console.mode.as_json:
        change = comparison.psnr
        console.emit(
            "compared",
            verdict=change.verdict,
            psnr_change_db=change.mean,
            psnr_change_by_size_db={n: d.mean for n, d in comparison.psnr_by_size.items()},
            interval_db=[change.low, change.high] if change.shown else None,
            views=change.views,
            files=[str(file) for file in files],
        )
        return
    if not console.mode.quiet:
        console.table(("", sides[0].name, sides[1].name), fact_rows(comparison))
    for line in verdict_lines(comparison):
        console.out.print(line, markup=False)
    console.out.print(str(files[0]), markup=False)


def _check_photographs(first: Pipeline, second: Pipeline) -> None:
    """Raises SplatError (compare-other-photographs)."""
    digests = []
    for run in (first, second):
        manifest = run.manifest("ingest")
        digests.append(manifest.inputs.get(PHOTOS) if manifest else None)
    if digests[0] != digests[1]:
        raise UsageError(
            "compare-other-photographs",
            given=f"{first.run_folder} and {second.run_folder} were made from other photographs.",
            wanted="Two runs of the same photographs: others are not equally hard to draw.",
            hint="Run `splat process` on the same folder twice, with another --out.",
        )


def _side(run: Pipeline, name: str) -> Candidate:
    splats = results.final_splats(run)
    facts = {"splats": f"{len(splats):,}", "SH degree": str(splats.sh_degree)}
    trained = run.manifest("train")
    if trained is not None:
        facts["training"] = console.duration(trained.seconds)
        steps = trained.metrics.get("steps", trained.settings["steps"])
        facts["steps"] = f"{steps:,}"
        facts["seed"] = str(trained.settings["seed"])
    for ending, figures in results.exported_formats(run).items():
        facts[f".{ending}"] = console.size(figures["size_bytes"])
    return Candidate(
        name, splats, results.reconstruction_of(run), results.backend_of_run(run), facts
    )
