"""What the machine refused, as an error that says what to do: disk, permissions, memory."""

from __future__ import annotations

import errno
from pathlib import Path

from stages.base.disk import is_full
from stages.base.errors import Family, SplatError

_DISK = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}
_DENIED = {errno.EACCES, errno.EPERM, errno.EROFS}
_USER = (Family.USAGE, Family.INPUT, Family.RUN_FOLDER)
_MEMORY_WORDS = ("can't allocate memory", "out of memory", "not enough memory")


def as_splat_error(error: BaseException, doing: str, folder: Path) -> SplatError | None:
    """The SplatError that explains `error`, or None if it is not the machine's refusal.

    doing: what was going on ("train"). folder: where it wrote. The chain of causes is searched,
    since libraries wrap what the system told them.
    """
    chain = _chain(error)
    if any(isinstance(link, OSError) and link.errno in _DISK for link in chain):
        return disk_full(doing, folder)
    # Libraries report a full disk as something else.
    full = isinstance(error, Exception) and is_full(folder)
    for link in chain:
        if isinstance(link, SplatError):
            # What ended in a process of its own cannot say why: a full disk explains it.
            return disk_full(doing, folder) if full and link.family not in _USER else link
        if isinstance(link, OSError) and link.errno in _DENIED:
            return not_writable(Path(link.filename or folder), link)
        if isinstance(link, MemoryError) or any(w in str(link).lower() for w in _MEMORY_WORDS):
            return out_of_memory(doing, link)
    return disk_full(doing, folder) if full else None


def _chain(error: BaseException) -> list[BaseException]:
    links: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in links:
        links.append(link)
        link = link.__cause__ or link.__context__
    return links


def disk_full(doing: str, folder: Path) -> SplatError:
    return SplatError(
        "disk-full",
        given=f"The disk of {folder} became full during {doing}.",
        wanted="Room for what the stage writes.",
        hint="Free some space and give the same command again: finished stages are kept.",
        family=Family.RESOURCES,
    )


def not_writable(path: Path, error: OSError) -> SplatError:
    return SplatError(
        "not-permitted",
        given=f"{path}: {error.strerror or error}.",
        wanted="A place that may be written to.",
        hint="Change its permissions, or name another folder with --out.",
        family=Family.RESOURCES,
    )


def out_of_memory(doing: str, error: BaseException) -> SplatError:
    said = str(error).splitlines()[0] if str(error) else type(error).__name__
    return SplatError(
        "out-of-memory",
        given=f"Memory ran out during {doing} ({said}).",
        wanted="Enough free memory for the settings.",
        hint="Close other programs, or ask for less: --max-splats, --train-side, --max-side.",
        family=Family.RESOURCES,
    )
