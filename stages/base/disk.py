"""Errors for what a disk refuses: room, and permission."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from stages.base.errors import ResourceError, SplatError

# Windows has no quota of this kind.
DISK_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
_FULL_BELOW_BYTES = 4 * 1024 * 1024


def disk_full(doing: str, folder: Path) -> SplatError:
    """The error for a disk that became full. doing: what was going on, such as "train"."""
    return ResourceError(
        "disk-full",
        given=f"The disk of {folder} became full during {doing}.",
        wanted="Free space for the output.",
        hint="Free some space, or use a folder on another disk, and run the same command again: "
        "what was finished is kept.",
    )


def link_or_copy(file: str, target: str) -> None:
    """Make `target` a link to the file, which no one may write into from then on, or a copy where
    the disk has no links. Raises OSError."""
    try:
        os.link(file, target)
    except OSError:
        shutil.copy2(file, target)


def is_full(place: Path) -> bool:
    """Whether the disk of `place`, or of its nearest parent that exists, has less than 4 MiB left.

    False where the system does not say, and for file systems without a size, such as /proc.
    """
    for folder in (place, *place.absolute().parents):
        try:
            usage = shutil.disk_usage(folder)
        except OSError:
            continue
        return usage.total > 0 and usage.free < _FULL_BELOW_BYTES
    return False


def not_permitted(path: Path, error: OSError) -> SplatError:
    """The error "not-permitted": `path` may not be read if the system says so, else not written."""
    place = next(p for p in (path, *path.absolute().parents) if os.path.lexists(p))
    needed = os.R_OK | os.X_OK if os.path.isdir(place) else os.R_OK
    reads = error.errno != errno.EROFS and not os.access(place, needed)
    other = "place; a run goes on there with `splat process RUN --out FOLDER`."
    return ResourceError(
        "not-permitted",
        given=f"{path}: {error.strerror or error}.",
        wanted=f"A file or folder that you may {'read' if reads else 'write to'}.",
        hint=f"Change its permissions, or name another {'one.' if reads else other}",
    )
