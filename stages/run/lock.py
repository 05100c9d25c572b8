"""A lock on a run folder: one process at a time works on it.

The operating system holds the lock, not the existence of a file: it ends with the process, so a
killed process leaves no stale lock. A second file names the holder, for the error message.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.base.errors import RunFolderError, SplatError

LOCK = ".lock"
HOLDER = ".lock-holder"  # process id of whoever holds it
_PATIENCE_S = 0.5  # a process that was killed may hold it a moment longer


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock inside the block. Raises SplatError (run-folder-busy), OSError."""
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=_PATIENCE_S)
    except Timeout:
        raise _busy(folder) from None
    note = folder / HOLDER
    try:
        note.write_text(f"{os.getpid()}\n")
        yield
    finally:
        with suppress(OSError):
            note.unlink(missing_ok=True)
        lock.release()


def holder(folder: Path) -> int | None:
    """Id of the process that holds the folder's lock now; None if none does or it is not known."""
    from filelock import FileLock, Timeout

    try:
        if (folder / LOCK).exists():
            with FileLock(folder / LOCK, timeout=0):
                return None
    except Timeout:
        with suppress(OSError, ValueError):
            return int((folder / HOLDER).read_text())
    except OSError:
        pass
    return None


def _busy(folder: Path) -> SplatError:
    pid = holder(folder)
    who = f"process {pid}" if pid else "another process"
    return RunFolderError(
        "run-folder-busy",
        given=f"{folder} is in use by {who}.",
        wanted="One process at a time in a run folder.",
        hint="Wait for it, stop it, or name another folder with --out.",
    )
