"""`splat batch`: a run folder for each of many captures, and one table of how they went."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console, log, options, progress, run_settings
from stages.base.atomic import make_folder
from stages.run.batch import BatchTable, Result, Row, run_capture, run_names
from stages.run.lock import locked
from stages.run.runfolder import check_outside


def batch(
    captures: Annotated[
        list[Path],
        typer.Argument(help="Folders of photographs, or videos: one run for each."),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Folder for the run folders and batch.csv.",
            rich_help_panel="Output",
        ),
    ] = Path("runs"),
    **given: Any,
) -> None:
    """Many captures: `splat process` for each, into a run folder of its name.

    A capture that fails does not stop the others; the exit status is the worst. The same command
    again goes on where it stopped: what is finished is not done twice. batch.csv lists the results.
    """
    settings = run_settings.of_new_run(options.given_only(given))
    log.write_settings(settings)
    runs = run_names(captures)
    for photos in captures:
        check_outside(out, photos)
    bars = progress.Bars() if console.mode.has_notes and console.err.is_terminal else None
    make_folder(out)
    with locked(out):
        table = BatchTable(out, list(runs))
        for number, (name, photos) in enumerate(runs.items()):
            result = run_capture(out / name, photos, settings, bars)
            table.ended(number, result)
            _report(table.rows[number], result)
        table.write()
    _print(table)
    if table.worst_status:
        raise typer.Exit(table.worst_status)


def _report(row: Row, result: Result) -> None:
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
        console.emit("result", folder=str(table.folder), rows=[vars(row) for row in table.rows])
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
    console.out.print(str(table.file), markup=False)


def _db(row: Row) -> str:
    return f"{row.psnr_db} dB" if row.psnr_db != "" else "nothing held out"
