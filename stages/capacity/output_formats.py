"""The `--format` option, which two stages share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from stages.base.settings import setting
from stages.formats.table import FORMATS
from stages.surface.table import MESHES, MeshFormat

DEFAULT_FORMATS = ("ply", "splat", "glb", "usdz")
ALL_MESHES = "mesh"  # a value of `--format`: every format of meshes
CHOICES = (*FORMATS, ALL_MESHES, *MESHES)


def rounding_formats(names: Iterable[str]) -> tuple[str, ...]:
    """Those of the formats whose rounding needs fine-tuning, in the order of the table."""
    chosen = set(names)
    return tuple(n for n, row in FORMATS.items() if n in chosen and row.needs_finetuning)


def mesh_formats(names: Iterable[str]) -> list[MeshFormat]:
    """The mesh formats among the names."""
    endings = (e for name in names for e in (MESHES if name == ALL_MESHES else (name,)))
    return [MESHES[ending] for ending in dict.fromkeys(endings) if ending in MESHES]


def formats_setting(default: tuple[str, ...], help: str, **metadata: Any) -> Any:
    """The `formats` field of a stage's settings."""
    return setting(default, help, choices=CHOICES, **metadata)
