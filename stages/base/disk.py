"""Room on a disk."""

from __future__ import annotations

import shutil
from pathlib import Path

_FULL_BELOW_BYTES = 4 * 1024 * 1024


def is_full(place: Path) -> bool:
    """Whether next to nothing can be written to the disk of `place`, or of the nearest folder
    above it that there is. False where the system does not say; /proc and its like have no size.
    """
    for folder in (place, *place.absolute().parents):
        try:
            usage = shutil.disk_usage(folder)
        except OSError:
            continue
        return usage.total > 0 and usage.free < _FULL_BELOW_BYTES
    return False
