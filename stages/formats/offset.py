"""The origin of a georeferenced scene, in a file of JSON beside those that have no field for it."""

from __future__ import annotations

import json
from pathlib import Path

from stages.base.atomic import replacing
from stages.formats.table import Format
from stages.scene import Splats
from stages.scene.flip import FLIP


def offset_path(path: Path) -> Path:
    """The file beside `path` that holds its offset."""
    return path.with_name(f"{path.name}.offset.json")


def write_offset(path: Path, row: Format, splats: Splats, units: str) -> None:
    """Write the origin of `splats` beside `path`, in the axes of the format; remove the file that
    an earlier scene left if there is no origin. Raises SplatError when it cannot be written."""
    beside = offset_path(path)
    if not splats.origin.any():
        beside.unlink(missing_ok=True)
        return
    offset = splats.origin * (FLIP if row.y_up else 1) + 0.0  # no negative zeros
    content = {
        "file": path.name,
        "offset": [float(value) for value in offset],
        "axes": "right, up, back" if row.y_up else "right, down, forward",
        "units": units,
    }
    with replacing(beside) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
