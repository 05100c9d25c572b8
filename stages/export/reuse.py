"""Takes files from the export before this one that would come out the same."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from stages.base.stage import Earlier, Report
from stages.formats.format_table import FORMATS
from stages.formats.mesh_table import MESHES
from stages.formats.offset import offset_path
from stages.scene import Splats
from stages.scene.storage import FIELDS


def digest_of(*models: Splats | None) -> str:
    """SHA-256 of all values of the models, hexadecimal."""
    whole = hashlib.sha256()
    for splats in models:
        for name in FIELDS if splats is not None else ():
            array = np.ascontiguousarray(getattr(splats, name))
            whole.update(f"{name} {array.dtype.str} {array.shape} ".encode())
            whole.update(array.data)
        if splats is not None:
            whole.update(repr((astuple(splats.draw_settings), splats.place)).encode())
        whole.update(b"|")
    return whole.hexdigest()


def take_file(ending: str, path: Path, made_from: str, report: Report) -> dict[str, Any] | None:
    """Copy the file at the name of `path` from the earlier export, with those beside it; returns
    its figures, and repeats its warnings. ending: of the splat or mesh format. None if it was not
    made from the splats of the digest `made_from` and for the same cameras. Raises OSError."""
    figures = _figures(report.earlier, ending, made_from)
    if figures is None or report.earlier is None:
        return None
    source = report.earlier.folder / path.name
    files = {source} if ending in MESHES else {*FORMATS[ending].files(source), offset_path(source)}
    for file in files:
        if file.is_file():
            shutil.copyfile(file, path.with_name(file.name))
    _repeat_warnings(report.earlier, ending, report)
    return figures


def _figures(earlier: Earlier | None, ending: str, made_from: str) -> dict[str, Any] | None:
    if earlier is None or "sfm" not in earlier.same_inputs:
        return None
    found = earlier.metrics.get("formats", {}).get(ending, {})
    return dict(found) if found.get("made_from") == made_from else None


def _repeat_warnings(earlier: Earlier, ending: str, report: Report) -> None:
    start = "export-mesh-" if ending in MESHES else f"export-{ending.replace('.', '-')}-"
    for code, text in earlier.warnings:
        if code.startswith(start):
            report.warn(code, text)
