"""Runs of many captures, one after the other: their names, and the table of their results."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

from stages.base.atomic import write_csv
from stages.base.errors import CRASHED, Interrupted, SplatError, UsageError
from stages.base.text import reason_of
from stages.run.failures import as_splat_error
from stages.run.listener import Listener
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_NAMES

FILE_NAME = "batch.csv"
WAITING, DONE = "waiting", "done"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """A line of batch.csv; figures are "" where they are not known.

    status: "waiting", "done", or the code of the error. seconds: of all stages, whenever they ran.
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


@dataclass(frozen=True)
class Result:
    """How a run ended. status: exit status. code, message: of the error; "" if there was none."""

    status: int = 0
    code: str = ""
    message: str = ""


def run_names(captures: Sequence[Path]) -> dict[str, Path]:
    """Captures by the name of their run folder: the name of the folder, or of the video without its
    suffix. Raises SplatError "batch-same-name"."""
    runs: dict[str, Path] = {}
    taken: dict[str, Path] = {}
    for path in captures:
        name = path.absolute().stem if path.is_file() else path.absolute().name
        if not name or name.casefold() in taken:
            other = taken.get(name.casefold(), path)
            raise UsageError(
                "batch-same-name",
                given=f"{other} and {path} would both be the run {name or 'without a name'}.",
                wanted="Captures of different names: each gives its run folder its own.",
                hint="Name the folders above them (captures/*), or rename one.",
            )
        runs[name] = taken[name.casefold()] = path
    return runs


def run_capture(
    run_folder: Path, photos: Path, settings: Mapping[str, Any], listener: Listener | None
) -> Result:
    """Run all stages. A failure becomes a result; only Interrupted is raised."""
    try:
        Pipeline(run_folder, photos).run(settings, listener=listener)
    except Interrupted:
        raise
    except Exception as error:
        _log.debug("%s failed", run_folder, exc_info=error)
        known = as_splat_error(error, "the run", run_folder)
        if known is None:
            return Result(CRASHED, "bug", f"{type(error).__name__}: {reason_of(error)}.")
        return Result(int(known.family), known.code, known.given)
    return Result()


class BatchTable:
    """The results of all runs, kept in batch.csv.

    Args:
        folder: has the run folders.
        names: of the run folders.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.folder, self.file = folder, folder / FILE_NAME
        self.rows = [Row(name) for name in names]
        self.worst_status = 0
        self.write()

    def ended(self, number: int, result: Result) -> None:
        """Record the result of a run."""
        row = row_of(self.folder / self.rows[number].capture)
        self.rows[number] = replace(row, status=result.code or DONE)
        self.worst_status = max(self.worst_status, result.status)
        with suppress(SplatError):  # a full disk makes the runs fail; the batch goes on
            self.write()

    def write(self) -> None:
        """Write batch.csv, whole or not at all. Raises SplatError."""
        names = [field.name for field in fields(Row)]
        write_csv(self.file, (names, *map(astuple, self.rows)))


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
