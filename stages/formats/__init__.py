"""Files of splats: one table of formats, one or two modules each, read and write, nothing else.

`write` takes splats in our own conventions (y down, ln scales, logit opacity) and `read` gives
them back so; each format's own axes and units of measure stay inside its module.

A new format, in five steps:
1. A module here with `write(path, splats, *, units)`, which writes by `base.atomic.replacing` what
   `rows.kept_rows` leaves, a block at a time by `base.blocks.passing`, and says how many it left
   out.
2. In the same module, or in one beside it if it grows, `read(path)`: its work inside
   `base.bad_files.reading`, its result through `rows.checked`.
3. A second reader, of a library that we did not write or of raw bytes, and an anatomy: in `proof`.
   What each takes and gives is said at `table.Format`.
4. A row in `table.TABLE`. `splat export`, `convert`, `verify`, `info` and their help, the fuzzer
   and the tests of every format know it from then on.
5. README's table: `pytest tests/formats/test_table.py` prints the line that is missing.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.atomic import clear_left
from stages.base.lazy import named
from stages.formats.table import BY_ENDING, FORMATS, MESHES, TABLE, ByteBreakdown, Format, format_of
from stages.formats.units import units_of

if TYPE_CHECKING:
    from stages.scene import Splats, View

__all__ = [
    "BY_ENDING",
    "FORMATS",
    "MESHES",
    "TABLE",
    "ByteBreakdown",
    "Format",
    "format_of",
    "read",
    "units_of",
    "write",
]


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", views: tuple[View, ...] = ()
) -> int:
    """Write `splats` in the format that the suffix of `path` names, whole or not at all; return
    how many could not be drawn (values not finite, or too large) and were left out.

    units: "metres" or "arbitrary", noted in the formats that can carry it.
    views: cameras in the frame of `splats.means` to look from, for the formats that show them.
    Raises SplatError as `format_of`, or what keeps the file from being written.
    """
    row = format_of(path)
    clear_left(Path(path).parent)
    more: dict[str, Any] = {"views": views} if row.wants_views else {}
    dropped: int = named(row.writer)(Path(path), splats, units=units, **more)
    return dropped


def read(path: Path, *, strict: bool = True) -> Splats:
    """The splats of a file, float32, y down.

    strict: whether a value that is not finite makes the file unreadable. Raises SplatError as
    `format_of`, or "splats-unreadable".
    """
    from stages.formats.rows import damage_kept

    reader = named(format_of(path).reader)
    with nullcontext() if strict else damage_kept():
        splats: Splats = reader(Path(path))
    return splats
