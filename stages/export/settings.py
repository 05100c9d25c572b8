"""Settings of the export. Neither NumPy nor torch is imported for them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from stages.base.settings import setting
from stages.base.stage import Stage, in_module
from stages.formats.output_formats import (
    DEFAULT_FORMATS,
    FIRST_PARTS,
    drawing_setting,
    formats_setting,
)
from stages.raster.backends import backend_setting

# Every system must take the name, USD's packages too: brackets separate names inside them.
_NO_FIRST_PART = rf"(?!(?i:.*\.(?:{'|'.join(map(re.escape, FIRST_PARTS))}))$)"
_NAME = _NO_FIRST_PART + r"(?!assets$)(?![ .])[^/\\:*?\"<>|\[\]\x00-\x1f]{1,100}(?<![ .])"


@dataclass(frozen=True)
class ExportSettings:
    """Settings of the export."""

    formats: tuple[str, ...] = formats_setting(
        DEFAULT_FORMATS,
        "File format to write; repeatable. mesh is a collision proxy, as .glb and .ply",
        panel="Output",
    )
    name: str = setting(
        "scene",
        "Name of the files, without a suffix.",
        pattern=_NAME,
        wanted="A name that every system takes: letters, digits, spaces, - and _; no "
        "folder, no suffix, and no end such as .compressed: with .ply that is another format.",
    )
    backend: str = backend_setting()
    drawing: str = drawing_setting()
    mesh_triangles: int = setting(
        50_000, "Triangles of the mesh, at most about.", min=100, max=100_000_000
    )


STAGE = Stage(
    "export",
    version=17,
    reads=("sfm", "quantise"),
    settings_type=ExportSettings,
    adds="formats",
    **in_module("stages.export.stage"),
)
