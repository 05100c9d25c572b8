"""A new run folder that begins with what another one holds: its settings and finished stages."""

from __future__ import annotations

import shutil
from pathlib import Path

from stages.base.atomic import rename
from stages.base.disk import link_or_copy
from stages.base.errors import RunFolderError
from stages.run.failures import unusable
from stages.run.manifest import MANIFEST, Manifest
from stages.run.runfile import RUN_FILE, RunFile
from stages.run.runfolder import check_outside


def branch(source: Path, target: Path) -> None:
    """Make the run folder `target` from the run folder `source`, which stays as it is.

    Files that stages wrote are hard links where the disk allows it, because no stage changes a
    finished file. Later changes of settings concern `target` alone, and run the stages again that
    they affect. Raises SplatError "run-folder-foreign" if `target` holds anything, and
    "run-folder-unusable" or one for a full disk.
    """
    recorded = RunFile.read(source)
    if recorded is not None and recorded.photographs is not None:
        check_outside(target, recorded.photographs)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RunFolderError(
            "run-folder-foreign",
            given=f"{target} exists and holds other things.",
            wanted=f"A new folder for a run that begins as {source}.",
            hint="Name another folder with --out.",
        )
    half = target.parent / f".{target.name}.partial"
    try:
        shutil.rmtree(half, ignore_errors=True)
        half.mkdir(parents=True)
        for path in sorted(source.glob(f"[1-9]-*/{MANIFEST}")):
            _copy(path.parent, half / path.parent.name)
        if (source / RUN_FILE).exists():
            shutil.copy2(source / RUN_FILE, half / RUN_FILE)
        if target.exists():
            target.rmdir()
        rename(half, target)
    except OSError as error:
        raise unusable(error, target) from error
    finally:
        shutil.rmtree(half, ignore_errors=True)


def _copy(folder: Path, target: Path) -> None:
    """The folder of a finished stage: its own files as links, others as copies."""
    manifest = Manifest.read(folder)
    own = {folder / name for name in (manifest.outputs if manifest else {})}

    def linked_if_own(file: str, copied: str) -> None:
        (link_or_copy if Path(file) in own else shutil.copy2)(file, copied)

    # Links of others may lead nowhere, or to large folders.
    shutil.copytree(folder, target, symlinks=True, copy_function=linked_if_own)
