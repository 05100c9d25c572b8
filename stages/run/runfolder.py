"""Checks when a run folder is opened: made by splat, from these photographs, not in use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stages.base.errors import RunFolderError, SplatError, UsageError
from stages.base.text import quoted
from stages.run.digests import combined_digest, record_files
from stages.run.lock import HOLDER, LOCK, locked
from stages.run.manifest import MANIFEST, Manifest
from stages.run.planning import PHOTOS
from stages.run.runfile import RUN_FILE, RunFile, holds_stages, stage_folder_around

# What a run that stopped before its run file was complete may leave.
_WITHOUT_RUN_FILE = (LOCK, HOLDER, RUN_FILE + ".tmp")


def is_run_folder(folder: Path) -> bool:
    """Whether splat made this folder. Its `run.json` may be lost if it holds stages."""
    return (folder / RUN_FILE).is_file() or holds_stages(folder)


def has_finished_work(folder: Path) -> bool:
    """Whether any stage has finished in this run folder."""
    return any(folder.glob(f"[1-9]-*/{MANIFEST}"))


@contextmanager
def opened(folder: Path, photos: Path | None) -> Iterator[None]:
    """Lock the run folder inside the block; make it if it is new.

    Without `photos` the folder must exist. Raises SplatError (photographs-missing,
    photographs-run-folder, run-folder-inside-photographs, run-folder-missing, run-folder-foreign,
    run-folder-busy, and those of `RunFile.read`, before anything is written), OSError.
    """
    if photos is not None:
        check_photos(folder, photos)
    if not is_run_folder(folder):
        if photos is None:
            raise missing(folder)
        if folder.exists() and any(path.name not in _WITHOUT_RUN_FILE for path in folder.iterdir()):
            raise RunFolderError(
                "run-folder-foreign",
                given=f"{folder} exists and holds other things.",
                wanted="A new folder, an empty one, or a run folder that splat made.",
                hint="Name another folder with --out.",
            )
    RunFile.read(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        yield


def recorded_for(folder: Path, photos: Path | None, first_stage_folder: Path) -> RunFile:
    """The folder's run file, with `photos` (an absolute path) as its photographs if given.

    A moved or copied folder of photographs is accepted. Other photographs are an error
    (run-folder-other-photographs) once a stage has finished. A new run folder gets an empty run
    file. Raises SplatError.
    """
    recorded = RunFile.read(folder)
    if recorded is None:
        return RunFile(photos)
    if photos is None or recorded.photographs == photos:
        return recorded
    moved = recorded.photographs is not None and not recorded.photographs.exists()
    if recorded.photographs is not None and not moved and recorded.photographs.samefile(photos):
        return recorded  # through a link, or with `..` in its path
    accepted = _shares_any if moved else _same
    if has_finished_work(folder) and not accepted(photos, first_stage_folder):
        before = recorded.photographs or "other photographs"
        raise RunFolderError(
            "run-folder-other-photographs",
            given=f"{folder} was made from {before}, not from {photos}.",
            wanted="One run folder for one set of photographs.",
            hint="Name another run folder with --out.",
        )
    return RunFile(photos, recorded.settings)


def _same(photos: Path, first_stage_folder: Path) -> bool:
    done = Manifest.read(first_stage_folder)
    if done is None:
        return False
    return combined_digest(record_files(photos, users=True)) == done.inputs.get(PHOTOS)


def _shares_any(photos: Path, first_stage_folder: Path) -> bool:
    """Whether a file is one of those that the run was made from, or these are not known."""
    done = Manifest.read(first_stage_folder)
    known = {} if done is None else done.input_files.get(PHOTOS, {})
    now = {record.sha256 for record in record_files(photos, users=True).values()}
    return not known or bool(now & {record.sha256 for record in known.values()})


def check_photos(folder: Path, photos: Path) -> None:
    """Raise SplatError where `photos` cannot be those of a run in `folder`."""
    if not photos.exists():
        raise SplatError(
            "photographs-missing",
            given=f"{photos} does not exist.",
            wanted="A folder of photographs.",
            hint="Check the path; put quotes around one with spaces.",
        )
    stage_folder = stage_folder_around(photos)
    if stage_folder is not None or is_run_folder(photos):
        what = f"belongs to {stage_folder}, which splat made" if stage_folder else "is a run folder"
        run = stage_folder.parent if stage_folder else photos
        raise UsageError(
            "photographs-run-folder",
            given=f"{photos} {what}.",
            wanted="A folder of photographs as they were taken.",
            hint=f"To continue the run: splat process {quoted(run)}",
        )
    check_outside(folder, photos)


def check_outside(folder: Path, photos: Path) -> None:
    """Raises SplatError (run-folder-inside-photographs)."""
    if folder.resolve().is_relative_to(photos.resolve()):
        raise UsageError(
            "run-folder-inside-photographs",
            given=f"The run folder {folder} would lie inside {photos}.",
            wanted="A run folder elsewhere: nothing is written among your photographs.",
            hint="Name one with --out, for example --out ../run",
        )


def missing(folder: Path) -> SplatError:
    """The error for a folder that is not a run folder."""
    return RunFolderError(
        "run-folder-missing",
        given=f"{folder} is not a run folder.",
        wanted="A folder that `splat process` made.",
        hint="Name one, or start one: splat process PHOTOS --out run/",
    )
