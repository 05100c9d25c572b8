"""The output of the pipeline: files that other programs open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ExportedFile:
    """One asset. format: its suffix without the dot. path: relative to the assets' folder.
    size_bytes: of all its files (with the .bin beside a .gltf)."""

    format: str
    path: str
    size_bytes: int


@dataclass(frozen=True)
class ExportedAssets:
    """The files of one export, in the order in which they were requested."""

    folder: Path
    files: tuple[ExportedFile, ...]
