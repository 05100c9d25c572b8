"""Errors of the operating system (disk, permissions, memory) as errors that say what to do."""

from __future__ import annotations

import errno
from pathlib import Path

from stages.base.disk import DISK_FULL, disk_full, is_full, not_permitted
from stages.base.errors import Family, ResourceError, RunFolderError, SplatError
from stages.base.text import printable, printable_name, reason_of

_DENIED = {errno.EACCES, errno.EPERM, errno.EROFS}
_PATH_LENGTH = 4096  # what is longer is the content of a file
_USER = (Family.USAGE, Family.INPUT, Family.RUN_FOLDER)
_MEMORY_WORDS = (
    "can't allocate memory",
    "out of memory",
    "not enough memory",
    "cannot allocate memory",
    "can't start new thread",
    "failed to map segment",
)


def as_splat_error(error: BaseException, doing: str, folder: Path) -> SplatError | None:
    """The SplatError that explains `error`, or None if the operating system did not cause it.

    The chain of causes is searched, because libraries wrap the system's own errors.

    Args:
        error: what was raised.
        doing: what was going on, such as "train".
        folder: where output was written.
    """
    chain = _chain(error)
    if any(isinstance(link, OSError) and link.errno in DISK_FULL for link in chain):
        return disk_full(doing, folder)
    # Some libraries report a full disk as another error.
    full = isinstance(error, Exception) and is_full(folder)
    for link in chain:
        if isinstance(link, SplatError):
            # A child process that ended cannot say why; a full disk explains it.
            return disk_full(doing, folder) if full and link.family not in _USER else link
        if isinstance(link, OSError) and link.errno in _DENIED:
            return not_permitted(Path(link.filename or folder), link)
        if isinstance(link, UnicodeEncodeError) and printable(link.object) != link.object:
            path = len(link.object) <= _PATH_LENGTH
            name = printable_name(link.object) if path else f"Something in {printable(str(folder))}"
            what = f"{name} has a name that is not UTF-8."
            return _unusable_name("name-not-utf-8", what)
        if isinstance(link, OSError) and link.errno == errno.ENAMETOOLONG:
            what = f"{link.filename or folder}: the name or the whole path is too long."
            return _unusable_name("name-too-long", what)
        if isinstance(link, MemoryError) or any(w in str(link).lower() for w in _MEMORY_WORDS):
            return out_of_memory(doing, link)
    return disk_full(doing, folder) if full else None


def unusable(error: OSError, run_folder: Path) -> SplatError:
    """The error for a run folder that the system refuses to make or to write to."""
    return as_splat_error(error, "the run", run_folder) or RunFolderError(
        "run-folder-unusable",
        given=f"{error.filename or run_folder}: {error.strerror or error}.",
        wanted="A run folder that can be made and written to.",
        hint="Check the path, or name another folder with --out.",
    )


def _unusable_name(code: str, given: str) -> SplatError:
    return SplatError(
        code,
        given=given,
        wanted="Names of files and folders that the system and its libraries can use.",
        hint="Rename it, or use another folder.",
    )


def _chain(error: BaseException) -> list[BaseException]:
    links: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in links:
        links.append(link)
        link = link.__cause__ or link.__context__
    return links


def out_of_memory(doing: str, error: BaseException) -> SplatError:
    return ResourceError(
        "out-of-memory",
        given=f"Memory ran out during {doing} ({reason_of(error)}).",
        wanted="Enough free memory for the settings.",
        hint="Close other programs, or ask for less: --max-splats, --train-side, --max-side.",
    )
