"""`splat batch`: a run folder for each of many captures, and one table of how they went."""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from splatcli import console, options
from splatcli.commands import process
from stages import STAGE_NAMES
from stages.base.atomic import replacing
from stages.base.errors import Family, SplatError
from stages.distributed import cluster, remote
from stages.distributed.tasks import Location, TaskResult, resources_of
from stages.run.manifest import Manifest

TABLE = "batch.csv"
WAITING, DONE = "waiting", "done"
_LOOK_EVERY_S = 1.0


@dataclass(frozen=True)
class Row:
    """A line of batch.csv. status: "waiting", "done", or the code of the error. seconds: of all
    stages, whenever they ran. psnr_db: held out, of what is exported. bytes: of the assets.
    warnings: their codes."""

    capture: str
    status: str = WAITING
    seconds: float | str = ""
    psnr_db: float | str = ""
    bytes: int | str = ""
    splats: int | str = ""
    warnings: str = ""


def batch(
    captures: Sequence[str],
    out: str,
    address: str | None,
    given: Mapping[str, Any],
    quiet: bool,
    as_json: bool,
) -> None:
    """Bring each capture's run to its end; exit with the worst status of all. Raises SplatError
    for what concerns all of them, and Interrupted."""
    settings = process.fresh_settings(options.given_only(given))
    runs = remote.parse_location(out)
    photos = named(remote.expand_locations(captures))
    tasks = [
        remote.task_for(remote.joined(runs, name), path, settings) for name, path in photos.items()
    ]
    with (
        remote.prepare_output(runs) as here,
        cluster.open_executor(address, runs, photos.values()) as engine,
    ):
        board = Board(here, runs, list(photos))
        with board.shown(quiet, as_json):
            for number, ending in engine.results(tasks, resources_of(settings["train"])):
                board.ended(number, ending)
                board.tell(number, ending, quiet, as_json)
        board.write()
    board.show(quiet, as_json)
    if board.worst:
        raise typer.Exit(board.worst)


def named(captures: Sequence[Location]) -> dict[str, Location]:
    """Captures by the name of their run folder: the folder's or the video's own. Raises SplatError
    "batch-same-name"."""
    found: dict[str, Location] = {}
    taken: dict[str, Location] = {}
    for path in captures:
        name = remote.capture_name(path)
        if not name or name.casefold() in taken:
            other = taken.get(name.casefold(), path)
            raise SplatError(
                "batch-same-name",
                given=f"{other} and {path} would both be the run {name or 'without a name'}.",
                wanted="Captures of different names: each gives its run folder its own.",
                hint="Name the folders above them (captures/*), or rename one.",
                family=Family.USAGE,
            )
        found[name] = taken[name.casefold()] = path
    return found


class Board:
    """What is known of each run, on the screen and in batch.csv. out: the folder with what of the
    runs tells of them. runs: the folder that was asked for."""

    def __init__(self, out: Path, runs: Location, names: Sequence[str]) -> None:
        self.out, self.runs = out, runs
        self.rows = [Row(name) for name in names]
        self.worst = 0
        self.write()

    def ended(self, number: int, ending: TaskResult) -> None:
        """Note how a run ended."""
        name = self.rows[number].capture
        with suppress(SplatError):  # what cannot be read is told as blanks
            remote.fetch_manifests(self.runs, name, self.out)
        row = replace(figures_of(self.out / name), status=ending.code or DONE)
        self.rows[number] = row
        self.worst = max(self.worst, ending.status)
        with suppress(SplatError):  # a full disk fails the runs; the others go on
            self.write()

    def write(self) -> None:
        """batch.csv, whole or not at all. Raises SplatError."""
        with replacing(self.out / TABLE) as path, path.open("w", newline="", encoding="utf-8") as f:
            writer = csv.writer(f, lineterminator="\n")
            writer.writerow(field.name for field in fields(Row))
            writer.writerows(map(astuple, self.rows))
        if isinstance(self.runs, str):
            remote.RemoteFolder.at(self.runs).put(self.out, [TABLE])

    def tell(self, number: int, ending: TaskResult, quiet: bool, as_json: bool) -> None:
        """A line, or an event, for a run that ended."""
        row = self.rows[number]
        if as_json:
            console.emit("ended", **vars(row), exit_status=ending.status, said=ending.said)
        elif ending.status:
            console.note(f"{row.capture}: {ending.said} ({ending.code})", "red")
        elif not quiet and not console.err.is_terminal:
            seconds = console.duration(float(row.seconds or 0))
            console.note(f"{row.capture}: done in {seconds}, {_db(row)}")

    @contextmanager
    def shown(self, quiet: bool, as_json: bool) -> Iterator[None]:
        """On a terminal, a table of what is being done, until it is over."""
        if quiet or as_json or not console.err.is_terminal:
            yield
            return
        live = Live(
            get_renderable=self._now,
            console=console.err,
            refresh_per_second=1 / _LOOK_EVERY_S,
            transient=True,
        )
        with live:
            yield

    def _now(self) -> Table:
        """The runs at work, and how many wait, are done, or failed."""
        counts = Counter(r.status if r.status in (WAITING, DONE) else "failed" for r in self.rows)
        told = ", ".join(f"{count} {what}" for what, count in counts.items())
        drawn = Table(title=told, title_justify="left", box=None, pad_edge=False)
        for heading in ("capture", "stage", "for"):
            drawn.add_column(heading)
        for row in self.rows:
            at = stage_at(self.out / row.capture) if row.status == WAITING else None
            if at is not None:
                drawn.add_row(Text(row.capture), at[0], console.duration(at[1]))
        return drawn

    def show(self, quiet: bool, as_json: bool) -> None:
        """The whole table, once all is over."""
        if as_json:
            console.emit("result", folder=str(self.runs), rows=[vars(row) for row in self.rows])
            return
        if not quiet:
            console.table(
                ("capture", "status", "time", "held out", "size", "splats", "warnings"),
                [
                    (
                        row.capture,
                        row.status,
                        console.duration(float(row.seconds)) if row.seconds != "" else "-",
                        _db(row) if row.psnr_db != "" else "-",
                        console.size(float(row.bytes)) if row.bytes != "" else "-",
                        f"{row.splats:,}" if row.splats != "" else "-",
                        str(len(row.warnings.split())),
                    )
                    for row in self.rows
                ],
            )
        console.out.print(str(remote.joined(self.runs, TABLE)), markup=False)


def figures_of(run_folder: Path) -> Row:
    """What the manifests of a run folder say; blank where they say nothing, or are not whole."""
    found: dict[str, Manifest] = {}
    for number, name in enumerate(STAGE_NAMES, start=1):
        with suppress(SplatError):
            manifest = Manifest.read(run_folder / f"{number}-{name}")
            if manifest is not None:
                found[name] = manifest
    row = Row(run_folder.name)
    if found:
        codes = (code for manifest in found.values() for code, _ in manifest.warnings)
        seconds = round(sum(manifest.seconds for manifest in found.values()), 1)
        row = replace(row, seconds=seconds, warnings=" ".join(dict.fromkeys(codes)))
    quantise, export = found.get("quantise"), found.get("export")
    if quantise is not None and quantise.metrics.get("measured_on") == "held out":
        row = replace(row, psnr_db=round(quantise.metrics["psnr_kept_db"], 3))
    if export is not None:
        sizes = [f["size_bytes"] for f in export.metrics.get("formats", {}).values()]
        row = replace(row, bytes=sum(sizes), splats=export.metrics.get("splats", ""))
    return row


def stage_at(run_folder: Path) -> tuple[str, float] | None:
    """(the stage whose working folder lies there, seconds since it was begun), if one does."""
    for number, name in enumerate(STAGE_NAMES, start=1):
        with suppress(OSError):
            begun = (run_folder / f".{number}-{name}.partial").stat()
            return name, max(0.0, time.time() - begun.st_ctime)
    return None


def _db(row: Row) -> str:
    return f"{row.psnr_db} dB" if row.psnr_db != "" else "nothing held out"
