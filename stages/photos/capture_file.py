"""capture.json: what ingest found, for the later stages."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields
from pathlib import Path, PurePosixPath
from typing import Any

from stages.base.atomic import replacing
from stages.base.errors import Family, SplatError
from stages.scene import Capture, Photo

FILE = "capture.json"
_SCHEMA = 4
_TYPES: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "image": (str,),
    "width": (int,),
    "height": (int,),
    "focal_px": (float, int, type(None)),
    "camera": (str,),
    "sharpness": (float, int),
    "log2_luminance": (float, int),
    "exposure_ev": (float, int, type(None)),
    "duplicate_of": (str,),
    "mask": (str,),
    "outside": (str,),
    "gps": (list, type(None)),
}


def save_capture(capture: Capture) -> None:
    """Write capture.json into the capture's folder. Raises SplatError if it cannot be written."""
    data = {"schema": _SCHEMA, "photos": [asdict(photo) for photo in capture.photos]}
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    with replacing(capture.folder / FILE) as path:
        path.write_text(text + "\n", encoding="utf-8", newline="\n")


def load_capture(folder: Path) -> Capture:
    """The capture of a finished folder. Raises SplatError "ingest-capture-damaged"."""
    path = folder / FILE
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise _damaged(path, "it is missing") from error
    except (ValueError, RecursionError) as error:
        raise _damaged(path, f"it is not JSON ({str(error)[:80]})") from error
    if not isinstance(data, dict) or data.get("schema") != _SCHEMA:
        raise _damaged(path, f"it is not of schema {_SCHEMA}")
    rows = data.get("photos")
    if not isinstance(rows, list) or not rows:
        raise _damaged(path, "it lists no photographs")
    photos = tuple(_photo(path, number, row) for number, row in enumerate(rows, 1))
    for what in ("name", "image"):
        if len({getattr(photo, what) for photo in photos}) != len(photos):
            raise _damaged(path, f"two photographs have the same {what}")
    return Capture(folder, photos)


def _photo(path: Path, number: int, row: Any) -> Photo:
    where = f"photograph {number}"
    if not isinstance(row, dict) or set(row) != {item.name for item in fields(Photo)}:
        raise _damaged(path, f"{where} has missing or unknown fields")
    for name, types in _TYPES.items():
        value = row[name]
        if not isinstance(value, types) or isinstance(value, bool):
            raise _damaged(path, f"{name} of {where} is {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise _damaged(path, f"{name} of {where} is {value}")
    for name in ("width", "height", "focal_px"):
        if row[name] is not None and row[name] <= 0:
            raise _damaged(path, f"{name} of {where} is {row[name]}")
    for what, file in (("picture", row["image"]), ("mask", row["mask"])):
        inside = PurePosixPath(file)
        outside = inside.is_absolute() or ".." in inside.parts
        if outside or (not (path.parent / inside).is_file() and (file or what == "picture")):
            raise _damaged(path, f"the {what} of {where}, {file}, is not there")
    gps = row.pop("gps")
    if gps is not None and not (len(gps) == 2 and all(isinstance(v, float) for v in gps)):
        raise _damaged(path, f"gps of {where} is {gps!r}")
    return Photo(**row, gps=None if gps is None else (gps[0], gps[1]))


def _damaged(path: Path, why: str) -> SplatError:
    return SplatError(
        "ingest-capture-damaged",
        given=f"{path} cannot be used: {why}.",
        wanted="The file as ingest wrote it, with its pictures beside it.",
        hint="Delete the ingest folder of this run and run the command again.",
        family=Family.RUN_FOLDER,
    )
