"""The `--format` option, which two stages share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from stages.base.settings import setting
from stages.formats.format_table import AUTO, DRAWINGS, FORMATS
from stages.formats.mesh_table import MESHES, MeshFormat

DEFAULT_FORMATS = ("ply", "splat", "glb", "usdz")
LOSSLESS = "ply"
ALL_MESHES = "mesh"  # a value of `--format`: every format of meshes
CHOICES = (*FORMATS, ALL_MESHES, *MESHES)
# A name must not end in one of these: a.compressed and .ply together end as another format does.
FIRST_PARTS = tuple(
    sorted({ending.rpartition(".")[0] for ending in (*FORMATS, *MESHES) if "." in ending})
)


def formats_to_finetune(names: Iterable[str], drawing: str) -> tuple[str, ...]:
    """Those of the formats that need fine-tuning, in the order of the table: to their rounding, and
    to being drawn plainly. "ply" stands for all that are drawn plainly and round nothing, because
    all these hold the same splats."""
    chosen = {FORMATS[name] for name in names if name in FORMATS}
    plain = any(not row.needs_finetuning and not row.holds_antialiased(drawing) for row in chosen)
    rounding = (n for n, row in FORMATS.items() if row in chosen and row.needs_finetuning)
    return (*((LOSSLESS,) if plain else ()), *rounding)


def mesh_formats(names: Iterable[str]) -> list[MeshFormat]:
    """The mesh formats among the names."""
    endings = (e for name in names for e in (MESHES if name == ALL_MESHES else (name,)))
    return [MESHES[ending] for ending in dict.fromkeys(endings) if ending in MESHES]


def formats_setting(default: tuple[str, ...], help: str, **metadata: Any) -> Any:
    """The `formats` field of a stage's settings."""
    return setting(default, help, choices=CHOICES, **metadata)


def drawing_setting() -> Any:
    """The `drawing` field of a stage's settings."""
    return setting(
        AUTO,
        "How viewers will draw the files: antialiased (opacities compensated, right at every size "
        "and distance), plain, or auto: as the programs that a format is for draw it.",
        choices=DRAWINGS,
        panel="Output",
    )
