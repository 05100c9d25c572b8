"""Which run folder a command is about when none is named."""

from __future__ import annotations

from pathlib import Path

from stages.base.errors import Family, SplatError
from stages.run import runfolder

DEFAULT = Path("run")


def find_run_folder(named: Path | None = None) -> Path:
    """The named run folder; else the current folder, `run/`, or the only one in it; those in
    which nothing ever succeeded count only if there is no other.

    Raises SplatError: run-folder-missing, run-folder-unclear.
    """
    if named is not None:
        if not runfolder.is_run_folder(named):
            raise runfolder.missing(named)
        return named
    here = Path()
    if runfolder.is_run_folder(here):
        return here
    every = sorted(path for path in here.iterdir() if runfolder.is_run_folder(path))
    found = [path for path in every if runfolder.has_finished_work(path)] or every
    if DEFAULT in found:
        return DEFAULT
    if len(found) == 1:
        return found[0]
    if found:
        raise SplatError(
            "run-folder-unclear",
            given=f"There are several run folders here: {', '.join(map(str, found))}.",
            wanted="One of them.",
            hint=f"Name it: splat status {found[0]}",
            family=Family.USAGE,
        )
    raise SplatError(
        "run-folder-missing",
        given=f"There is no run folder in {here.resolve()}.",
        wanted="A run folder, named or in the current folder.",
        hint="Start one with `splat process PHOTOS`, or name one that exists.",
        family=Family.RUN_FOLDER,
    )
