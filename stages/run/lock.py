"""One process at a time works on a run folder.

The lock belongs to the operating system, not to the file's existence: a process that was killed
holds it no longer, so there are no stale locks to clean up. The file's text only names the holder.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from stages.base.errors import Family, SplatError

LOCK = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock. Raises SplatError (run-folder-busy), OSError."""
    with (folder / LOCK).open("a+") as file:
        if not _try_lock(file):
            raise _busy(folder)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        try:
            yield
        finally:
            with suppress(OSError):
                file.truncate(0)
            _unlock(file)


def holder(folder: Path) -> int | None:
    """Process id that works on the folder now, or None."""
    path = folder / LOCK
    try:
        with path.open("r+") as file:
            if _try_lock(file):
                _unlock(file)
                return None
            file.seek(0)
            return int(file.read().strip() or 0)
    except (OSError, ValueError):
        return None


def _busy(folder: Path) -> SplatError:
    pid = holder(folder)
    who = f"process {pid}" if pid else "another process"
    return SplatError(
        "run-folder-busy",
        given=f"{folder} is being worked on by {who}.",
        wanted="One process at a time in a run folder.",
        hint="Wait for it, stop it, or name another folder with --out.",
        family=Family.RUN_FOLDER,
    )


def _try_lock(file: IO[str]) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(2**30)  # far behind the text, so that others can still read the holder's id
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _unlock(file: IO[str]) -> None:
    with suppress(OSError):
        if sys.platform == "win32":
            import msvcrt

            file.seek(2**30)
            msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_UN)
