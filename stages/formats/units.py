"""The units that our files declare."""

from __future__ import annotations

import re
from pathlib import Path

from stages.base.bad_files import reading

_START_BYTES = 1 << 16
_METRES = re.compile(rb"\bunits\"?\s*[:=]\s*\"?metres\b")


def units_of(path: Path) -> str:
    """ "metres" where the start of the file declares it, as our .ply, glTF and .sog do; else
    "arbitrary". Raises SplatError "splats-unreadable"."""
    with reading(Path(path)), Path(path).open("rb") as file:
        start = file.read(_START_BYTES)
    return "metres" if _METRES.search(start) else "arbitrary"
