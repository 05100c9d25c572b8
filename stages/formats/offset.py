"""Origin and place of a scene, in a JSON file beside a splat file whose format has no field for
them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.base.atomic import replacing
from stages.formats.format_table import Format
from stages.formats.json_fields import located
from stages.scene import Splats
from stages.scene.flip import flipped


def offset_path(path: Path) -> Path:
    """The file beside `path` that holds its offset."""
    return path.with_name(f"{path.name}.offset.json")


def write_offset(path: Path, row: Format, splats: Splats, units: str) -> None:
    """Write origin and place of `splats` beside `path`, in the axes of the format; if there is
    neither, remove the file that an earlier scene left. Raises SplatError when it cannot be
    written."""
    beside = offset_path(path)
    if not is_located(splats):
        beside.unlink(missing_ok=True)
        return
    said = flipped(splats.take(slice(0))) if row.y_up else splats
    content: dict[str, Any] = {
        "file": path.name,
        "offset": [float(value) for value in said.origin],
        "axes": "right, up, back" if row.y_up else "right, down, forward",
        "units": units,
    }
    if said.place is not None:
        content["splat_place"] = said.place.beside(said.origin).to_json()
    with replacing(beside) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_offset(path: Path, row: Format, splats: Splats) -> Splats:
    """The splats of the file at `path` with the origin and the place that the file beside it holds.
    Raises BadFileError, or what damaged bytes cause."""
    content = json.loads(offset_path(path).read_text(encoding="utf-8"))
    holder = {
        "splat_origin": content.get("offset", [0, 0, 0]),
        "splat_place": content.get("splat_place"),
    }
    said = located(splats.take(slice(0)), holder)
    said = flipped(said) if row.y_up else said
    return replace(splats, origin=said.origin, place=said.place)


def read_units(path: Path) -> str:
    """The units that the file beside `path` declares; "" if it declares none. Raises what damaged
    bytes cause."""
    return str(json.loads(offset_path(path).read_text(encoding="utf-8")).get("units", ""))


def is_located(splats: Splats) -> bool:
    """Whether there is something to say of where they lie."""
    return bool(splats.origin.any()) or splats.place is not None
