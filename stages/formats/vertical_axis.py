"""The warning of a .ply whose vertical axis is not that of the format, as nerfstudio writes it."""

from __future__ import annotations

from pathlib import Path

from stages.base.bad_files import reading
from stages.base.text import quoted
from stages.formats.format_table import format_of
from stages.formats.ply_header import read_header


def vertical_warning(path: Path, target: Path | None = None) -> str:
    """A sentence where a comment of a .ply says that another axis than y is vertical, which would
    lie on its side in viewers; else "". target: the file that is written, for the advice. Raises
    SplatError as `format_of`, or "splats-unreadable"."""
    if format_of(path).ending not in ("ply", "compressed.ply"):
        return ""
    with reading(path), path.open("rb") as file:
        axis = read_header(file).vertical
    if axis.removeprefix("-") in ("", "y"):  # Brush says "y" of worlds of y down
        return ""
    up = axis if axis.startswith("-") else f"+{axis}"
    turned = f"splat edit {quoted(path)} {quoted(target or 'upright.ply')} --up {up}"
    return (
        f"{path} says that its vertical axis is {axis}. Here y points down, so the scene lies on "
        f"its side: `{turned}` turns it upright."
    )
