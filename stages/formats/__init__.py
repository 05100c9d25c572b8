"""Splat files: one table of formats, and one or two modules for each that read and write it.

`write` takes splats in our conventions (y down, ln scales, logit opacities) and `read` returns
them so. The axes and encodings of a format stay inside its module.

To add a format, in six steps:
1. Write `write(path, splats, *, units)` in a module here. Its splats are all drawable. It writes
   through `base.atomic.replacing`, one slice of `base.row_slices.row_slices` at a time.
2. Write `read(path)` in the same module, or in one beside it. It raises
   `base.bad_files.BadFileError`, or what damaged bytes cause in Python and NumPy; `formats.read`
   turns both into SplatError, and checks the values.
3. Add a row to `format_table.TABLE`, and its functions to `codecs.CODECS`. `splat export`,
   `convert`, `verify`, `info` and their help, the fuzzer and the tests of all formats are driven by
   the table.
4. Write an independent reader (of a library, or of raw bytes) in `stages.proof`, and add its row
   to `stages.proof.checks.CHECKS`.
5. Say in the tables of `tests/docs_tables.py` what the format opens in and keeps, and run
   `python -m tests.docs_tables`, which writes the tables of the documentation.
6. Run `pytest tests/formats tests/proof tests/fuzz`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.atomic import remove_abandoned_files
from stages.base.bad_files import reading
from stages.formats.format_table import BY_ENDING, FORMATS, Format, format_of

if TYPE_CHECKING:
    from stages.scene import Splats, View

__all__ = [
    "BY_ENDING",
    "FORMATS",
    "Format",
    "format_of",
    "read",
    "units_of",
    "write",
]
_START_BYTES = 1 << 16
_METRES = re.compile(rb"\bunits\"?\s*[:=]\s*\"?metres\b")


def write(
    path: Path,
    splats: Splats,
    *,
    units: str = "arbitrary",
    views: tuple[View, ...] = (),
    coarser: Sequence[Splats] = (),
) -> int:
    """Write `splats` in the format that the suffix of `path` stands for, completely or not at all.

    Beside a format that cannot hold them, origin and place are written to
    `offset.offset_path(path)`.

    Args:
        path: the file to write.
        splats: in our conventions: y down, ln scales, logit opacities.
        units: "metres" or "arbitrary", noted in the formats that can hold it.
        views: cameras in the frame of `splats.means`, for the formats that hold cameras, or the
            first.
        coarser: coarser levels of detail, finest first, for the formats that hold levels.

    Returns how many splats could not be drawn (values not finite, or too large) and were left out.
    Raises SplatError as `format_of`, or what keeps the file from being written.
    """
    from stages.formats import codecs, offset, values  # they load NumPy, the table does not

    row = format_of(path)
    remove_abandoned_files(Path(path).parent)
    more: dict[str, Any] = {"views": views} if row.takes_views else {}
    if row.streamed:
        more["coarser"] = coarser
    splats, dropped = values.drop_undrawable(splats)
    if views:
        first = min(views, key=lambda view: view.name)
        splats = replace(splats, first_camera=first.camera)
    codecs.CODECS[row.ending].write(Path(path), splats, units=units, **more)
    if not row.holds_origin:
        offset.write_offset(Path(path), row, splats, units)
    return dropped


def read(path: Path, *, strict: bool = True) -> Splats:
    """The splats of a file, float32, y down.

    strict: whether a value that is not finite makes the file unreadable. Raises SplatError as
    `format_of`, or "splats-unreadable".
    """
    from stages.formats import codecs, offset, values  # they load NumPy, the table does not

    path, row = Path(path), format_of(path)
    with nullcontext() if strict else values.nonfinite_allowed(), reading(path):
        splats = values.check_finite(codecs.CODECS[row.ending].read(path))
    if row.holds_origin or not offset.offset_path(path).exists():
        return splats
    with reading(offset.offset_path(path)):
        return offset.read_offset(path, row, splats)


def read_drawable(path: Path) -> tuple[Splats, int]:
    """(the splats of the file that can be drawn, the number of others). Raises SplatError as
    `read`; a file with more splats that are not finite than others is unreadable."""
    from stages.formats import values  # it loads NumPy, which the table does without

    splats, others = values.drop_undrawable(read(path, strict=False))
    if others > len(splats):
        read(path)
    return splats, others


def units_of(path: Path) -> str:
    """ "metres" where the file, or the one beside it that holds its origin, declares them as ours
    do; else "arbitrary". Raises SplatError as `format_of`, or "splats-unreadable"."""
    from stages.formats import codecs, offset  # they load NumPy, the table does not

    path, row = Path(path), format_of(path)
    if not row.holds_origin:
        if not offset.offset_path(path).exists():
            return "arbitrary"
        with reading(offset.offset_path(path)):
            declared = offset.read_units(path)
    elif units := codecs.CODECS[row.ending].units:
        with reading(path):
            declared = units(path)
    else:
        with reading(path), path.open("rb") as file:
            declared = "metres" if _METRES.search(file.read(_START_BYTES)) else ""
    return "metres" if declared == "metres" else "arbitrary"
