"""capture.json: what ingest found, for the later stages."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Any

from stages.base.atomic import replacing
from stages.base.bad_files import BadFileError, reading, stage_output
from stages.scene import Capture, Face, Photo

FILE = "capture.json"
_SCHEMA = 5


def save_capture(capture: Capture) -> None:
    """Write capture.json into the capture's folder. Raises SplatError if it cannot be written."""
    data = {"schema": _SCHEMA, "photos": [_row(photo) for photo in capture.photos]}
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    with replacing(capture.folder / FILE) as path:
        path.write_text(text + "\n", encoding="utf-8", newline="\n")


def load_capture(folder: Path) -> Capture:
    """The capture of a finished folder. Raises SplatError "ingest-capture-damaged"."""
    path = folder / FILE
    with reading(path, stage_output("ingest-capture-damaged")):
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema"] != _SCHEMA or not data["photos"]:
            raise BadFileError(f"it lists no photographs of schema {_SCHEMA}")
        photos = tuple(_photo(dict(row)) for row in data["photos"])
        beside = [file for photo in photos for file in (photo.mask, photo.depth) if file]
        for file in [*(photo.image for photo in photos), *beside]:
            inside = PurePosixPath(file)
            if inside.is_absolute() or ".." in inside.parts or not (folder / inside).is_file():
                raise BadFileError(f"its picture {file} is not there")
        return Capture(folder, photos)


def _row(photo: Photo) -> dict[str, Any]:
    row = asdict(photo)
    if photo.face is None:
        del row["face"]
    if not photo.depth:
        del row["depth"]
    return row


def _photo(row: dict[str, Any]) -> Photo:
    gps, face = row.pop("gps"), row.pop("face", None)
    if face is not None:
        w, x, y, z = (float(value) for value in face["turn"])
        face = Face(str(face["rig"]), str(face["frame"]), (w, x, y, z))
    return Photo(**row, gps=None if gps is None else (float(gps[0]), float(gps[1])), face=face)
