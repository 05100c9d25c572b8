"""Whether a disk is full."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

from stages.base.errors import Family, SplatError

# Windows has no quota of this kind.
DISK_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
_FULL_BELOW_BYTES = 4 * 1024 * 1024


def disk_full(doing: str, folder: Path) -> SplatError:
    """The error for a disk that became full. doing: what was going on, such as "train"."""
    return SplatError(
        "disk-full",
        given=f"The disk of {folder} became full during {doing}.",
        wanted="Free space for the output.",
        hint="Free some space, or use a folder on another disk, and run the same command again: "
        "what was finished is kept.",
        family=Family.RESOURCES,
    )


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
