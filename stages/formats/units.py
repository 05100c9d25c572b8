"""In which units a file of ours says that it is."""

from __future__ import annotations

import re
from pathlib import Path

from stages.base.bad_files import reading

_START_BYTES = 1 << 16
_SAYS = re.compile(rb"\bunits\"?\s*[:=]\s*\"?metres\b")


def units_of(path: Path) -> str:
    """ "metres" where the file begins by saying so, as .ply, glTF and .sog of ours do; else
    "arbitrary". Raises SplatError "splats-unreadable"."""
    with reading(Path(path)), Path(path).open("rb") as file:
        start = file.read(_START_BYTES)
    return "metres" if _SAYS.search(start) else "arbitrary"
