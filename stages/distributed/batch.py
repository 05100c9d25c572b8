"""Runs of many captures: their names, and the table of their results."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

from stages.base.atomic import write_csv
from stages.base.errors import SplatError, UsageError
from stages.distributed import remote
from stages.distributed.remote import Location
from stages.distributed.tasks import TaskResult
from stages.run import runfolder
from stages.run.manifest import Manifest
from stages.run.stages import STAGE_NAMES

FILE_NAME = "batch.csv"
WAITING, DONE = "waiting", "done"


@dataclass(frozen=True)
class Row:
    """A line of batch.csv; figures are "" where they are not known.

    status: "waiting", "done", or the code of the error; beside "waiting", figures are those of
    earlier calls. seconds: of all stages, whenever they ran.
    psnr_db: of the exported splats on held-out views. size_bytes: of the exported files. warnings:
    their codes.
    """

    capture: str
    status: str = WAITING
    seconds: float | str = ""
    psnr_db: float | str = ""
    size_bytes: int | str = ""
    splats: int | str = ""
    warnings: str = ""


def run_names(captures: Sequence[Location]) -> dict[str, Location]:
    """Captures by the name of their run folder: the name of the folder or of the video. Raises
    SplatError "batch-same-name"."""
    runs: dict[str, Location] = {}
    taken: dict[str, Location] = {}
    for location in captures:
        name = remote.capture_name(location)
        if not name or name.casefold() in taken:
            other = taken.get(name.casefold(), location)
            raise UsageError(
                "batch-same-name",
                given=f"{other} and {location} would both be the run {name or 'without a name'}.",
                wanted="Captures of different names: each gives its run folder its own.",
                hint="Name the folders above them (captures/*), or rename one.",
            )
        runs[name] = taken[name.casefold()] = location
    return runs


def check_output(runs: Location, captures: Sequence[Location]) -> None:
    """Raises SplatError "run-folder-inside-photographs" for run folders among photographs."""
    for location in captures:
        if isinstance(runs, Path) and isinstance(location, Path):
            runfolder.check_outside(runs, location)


class BatchTable:
    """The results of all runs, kept in batch.csv, whose rows of other captures stay.

    Args:
        folder: a local folder with the run folders, or with copies of their manifests.
        runs: the location of the run folders.
        names: of the run folders.
    """

    def __init__(self, folder: Path, runs: Location, names: Sequence[str]) -> None:
        self.folder, self.runs = folder, runs
        self.rows = [row_of(folder / name) for name in names]
        self.others = [row for row in self._earlier() if row.capture not in names]
        self.worst_status = 0
        self.write()

    def _earlier(self) -> list[Row]:
        """The rows of earlier calls; none if batch.csv is missing or damaged."""
        if isinstance(self.runs, str):
            with suppress(SplatError):
                remote.RemoteFolder.at(self.runs).fetch([FILE_NAME], self.folder)
        try:
            with (self.folder / FILE_NAME).open(encoding="utf-8", newline="") as file:
                return [Row(**row) for row in csv.DictReader(file)]
        except (OSError, ValueError, TypeError, csv.Error):
            return []

    @property
    def location(self) -> Location:
        """The location of batch.csv."""
        return remote.joined(self.runs, FILE_NAME)

    def ended(self, number: int, result: TaskResult) -> None:
        """Record the result of a run."""
        name = self.rows[number].capture
        with suppress(SplatError):  # the figures stay blank
            remote.fetch_records(self.runs, name, self.folder)
        row = row_of(self.folder / name)
        self.rows[number] = replace(row, status=result.code or DONE)
        self.worst_status = max(self.worst_status, result.status)
        with suppress(SplatError):  # a full disk makes the runs fail; the batch goes on
            self.write()

    def write(self) -> None:
        """Write batch.csv, whole or not at all. Raises SplatError."""
        names = [field.name for field in fields(Row)]
        write_csv(self.folder / FILE_NAME, (names, *map(astuple, (*self.others, *self.rows))))
        if isinstance(self.runs, str):
            remote.RemoteFolder.at(self.runs).put(self.folder, [FILE_NAME])


def row_of(run_folder: Path) -> Row:
    """The figures in the manifests of a run folder; blank where one is missing or unreadable."""
    manifests: dict[str, Manifest] = {}
    for number, name in enumerate(STAGE_NAMES, start=1):
        with suppress(SplatError):
            manifest = Manifest.read(run_folder / f"{number}-{name}")
            if manifest is not None:
                manifests[name] = manifest
    row = Row(run_folder.name)
    if manifests:
        codes = (code for manifest in manifests.values() for code, _ in manifest.warnings)
        seconds = round(sum(manifest.seconds for manifest in manifests.values()), 1)
        row = replace(row, seconds=seconds, warnings=" ".join(dict.fromkeys(codes)))
    quantise, export = manifests.get("quantise"), manifests.get("export")
    if quantise is not None and quantise.metrics.get("measured_on") == "held out":
        row = replace(row, psnr_db=round(quantise.metrics["psnr_kept_db"], 3))
    if export is not None:
        sizes = [f["size_bytes"] for f in export.metrics.get("formats", {}).values()]
        row = replace(row, size_bytes=sum(sizes), splats=export.metrics.get("splats", ""))
    return row
