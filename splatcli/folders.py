"""Finds the run folder or the splats that a command line names."""

from __future__ import annotations

from pathlib import Path

from splatcli import console
from stages.base.errors import SplatError, UsageError
from stages.base.text import quoted
from stages.run import results, runfolder
from stages.run.pipeline import Pipeline
from stages.scene import Splats

DEFAULT = Path("run")


def run_folder_for(photos: Path) -> Path:
    """Where a run of `photos` belongs without --out: `run/`, or `run-NAME` with the photographs'
    name beside a `run/` that was made from others. Raises SplatError."""
    if not (photos.exists() and runfolder.is_run_folder(DEFAULT)):
        return DEFAULT
    pipeline, photos = Pipeline(DEFAULT), photos.absolute()
    try:
        runfolder.recorded_for(DEFAULT, photos, pipeline.stage_folder("ingest"))
    except SplatError as error:
        if error.code != "run-folder-other-photographs":
            raise
        return DEFAULT.with_name(f"{DEFAULT}-{photos.stem}")
    return DEFAULT


def find_run_folder(named: Path | None = None) -> Path:
    """The named run folder; else the current folder, `run/`, or the only run folder in the current
    folder. Run folders without a finished stage count only if there is no other.

    Raises SplatError: run-folder-missing, run-folder-unclear.
    """
    if named is not None:
        if not runfolder.is_run_folder(named):
            raise runfolder.missing(named)
        return named
    here = Path()
    if runfolder.is_run_folder(here):
        return here
    every = sorted(path for path in here.iterdir() if _is_readable_run_folder(path))
    folders = [path for path in every if runfolder.has_finished_work(path)] or every
    if DEFAULT in folders:
        return DEFAULT
    if len(folders) == 1:
        return folders[0]
    if folders:
        raise UsageError(
            "run-folder-unclear",
            given=f"There are several run folders here: {', '.join(map(str, folders))}.",
            wanted="One of them.",
            hint=f"Name it: splat status {quoted(folders[0])}",
        )
    raise runfolder.missing(here.resolve())


def _is_readable_run_folder(path: Path) -> bool:
    try:
        return runfolder.is_run_folder(path)
    except PermissionError:
        return False


def load_target(
    target: Path | None, strict: bool = True, antialias: bool = True
) -> tuple[Splats, Pipeline | None]:
    """(splats, the run's pipeline or None) of a splat file or of the newest stage of a run folder.

    Args:
        target: None for the run folder here.
        strict: whether a value that is not finite makes a file unreadable.
        antialias: of a run, see `results.newest_splats`.

    Prints a warning if stages of the run are out of date. Raises SplatError.
    """
    if target is not None and target.is_file():
        return results.read_file(target, strict), None
    if target is not None and not target.exists():
        raise SplatError(
            "file-missing",
            given=f"{target} does not exist.",
            wanted="A run folder or a splat file.",
            hint="Check the path.",
        )
    pipeline = Pipeline(find_run_folder(target))
    splats = results.newest_splats(pipeline, antialias)
    if stale := results.out_of_date(pipeline):
        console.warn(
            f"Warning: {' and '.join(dict.fromkeys(stale.values()))} ran again since "
            f"{', '.join(stale)} did. These are the splats of "
            f"{results.newest_stage_with_splats(pipeline)}; "
            f"`splat process {quoted(pipeline.run_folder)}` renews the rest."
        )
    return splats, pipeline
