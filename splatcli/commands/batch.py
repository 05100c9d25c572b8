"""`splat batch`: a run folder for each of many captures, and one table of how they went."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console, log, options, progress, run_settings
from splatcli.arguments import Cluster
from stages.base.errors import SplatError
from stages.distributed import remote
from stages.distributed.batch import BatchTable, Row, check_output, run_names
from stages.distributed.cluster import open_executor
from stages.distributed.tasks import TaskResult, resources_of, task_for
from stages.run.pipeline import Pipeline


def batch(
    captures: Annotated[
        list[str],
        typer.Argument(
            help="Folders of photographs, or videos: one run for each. Also URLs that fsspec "
            "knows, such as 's3://bucket/captures/*'."
        ),
    ],
    *,
    out: Annotated[
        str,
        typer.Option(
            "--out",
            "-o",
            help="Folder, or URL, for the run folders and batch.csv.",
            rich_help_panel="Output",
        ),
    ] = "runs",
    cluster: Cluster = None,
    **given: Any,
) -> None:
    """Many captures: `splat process` for each, into a run folder of its name.

    A capture that fails does not stop the others; the exit status is the worst. The same command
    again goes on where it stopped: what is finished is not done twice. batch.csv lists the results.
    """
    given = options.given_only(given)
    log.write_settings(run_settings.of_new_run(given))  # refuses options before a folder is made
    runs = remote.parse_location(out)
    photos = run_names(remote.expand_locations(captures))
    check_output(runs, [*photos.values()])
    bars = progress.Bars() if console.mode.has_notes and console.err.is_terminal else None
    with (
        remote.prepare_output(runs) as local_folder,
        open_executor(cluster, runs, photos.values(), bars) as executor,
    ):
        settings = {name: _settings(runs, name, local_folder, given) for name in photos}
        tasks = [task_for(remote.joined(runs, n), p, settings[n]) for n, p in photos.items()]
        table = BatchTable(local_folder, runs, list(photos))
        need = resources_of(*(of_run["train"] for of_run in settings.values()))
        for number, result in executor.results(tasks, need):
            table.ended(number, result)
            _report(table.rows[number], result)
        table.write()
    _print(table)
    if table.worst_status:
        raise typer.Exit(table.worst_status)


def _settings(
    runs: remote.Location, name: str, local_folder: Path, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Settings by stage name of the run `name`, whose records are copied to `local_folder` from a
    URL. Raises SplatError."""
    remote.fetch_records(runs, name, local_folder)
    try:
        recorded = run_settings.recorded(Pipeline(local_folder / name))
    except SplatError:  # the run itself will fail by it, and the others go on
        recorded = run_settings.defaults()
    return run_settings.with_options(recorded, given)


def _report(row: Row, result: TaskResult) -> None:
    """Print a line, or an event, for a run that ended."""
    if console.mode.as_json:
        console.emit("ended", **vars(row), exit_status=result.status, message=result.message)
    elif result.status:
        console.note(f"{row.capture}: {result.message} ({result.code})", "red")
    elif not console.mode.quiet:
        seconds = console.duration(float(row.seconds or 0))
        console.note(f"{row.capture}: done in {seconds}, {_db(row)}")


def _print(table: BatchTable) -> None:
    """The whole table, once all runs have ended."""
    if console.mode.as_json:
        console.emit("result", folder=str(table.runs), rows=[vars(row) for row in table.rows])
        return
    if not console.mode.quiet:
        console.table(
            ("capture", "status", "time", "held out", "size", "splats", "warnings"),
            [
                (
                    row.capture,
                    row.status,
                    console.duration(float(row.seconds)) if row.seconds != "" else "-",
                    _db(row) if row.psnr_db != "" else "-",
                    console.size(float(row.size_bytes)) if row.size_bytes != "" else "-",
                    f"{row.splats:,}" if row.splats != "" else "-",
                    str(len(row.warnings.split())),
                )
                for row in table.rows
            ],
        )
    console.out.print(str(table.location), markup=False)


def _db(row: Row) -> str:
    return f"{row.psnr_db} dB" if row.psnr_db != "" else "nothing held out"
