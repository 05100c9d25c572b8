"""How a splat file is checked by code that did not write it: one row for each format.

A row is found by the ending of the file's format in `formats.format_table`. To add one, write
the independent reader in `independent_readers` or `independent_packed` and name it here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.formats import format_of
from stages.proof import independent_packed, independent_readers, usd_validation
from stages.proof.content import Y_DOWN, Y_UP, FileContent
from stages.scene import Splats


@dataclass(frozen=True)
class Checks:
    """The checks of one format.

    Attributes:
        read: (path) -> Splats in the file's axes. It shares no code with the writer and may raise
            anything.
        validate: (path) -> errors that another program's validator finds.
    """

    read: Callable[[Path], Splats]
    validate: Callable[[Path], list[str]] = lambda path: []


_PLY = Checks(independent_readers.ply)
_GLTF = Checks(independent_readers.gltf)
_SPZ = Checks(independent_packed.spz)
_USD = Checks(independent_readers.usd, usd_validation.usd_errors)
CHECKS = {
    "ply": _PLY,
    "splat": Checks(independent_readers.splat),
    "glb": _GLTF,
    "gltf": _GLTF,
    "usda": _USD,
    "usdc": _USD,
    "usdz": _USD,
    "quantised.glb": _GLTF,
    "spz.glb": _GLTF,
    "compressed.ply": Checks(independent_packed.compressed_ply),
    "spz": _SPZ,
    "v4.spz": _SPZ,
    "sog": Checks(independent_packed.sog),
    "lod-meta.json": Checks(independent_packed.streamed_sog),
    "tileset.json": Checks(independent_readers.tileset),
    "html": Checks(independent_readers.html),
    "ksplat": Checks(independent_packed.ksplat),
}


def read_back(path: Path) -> FileContent:
    """What another program finds in the file. Raises whatever its parser raises: a file that was
    just written must be readable."""
    row = format_of(path)
    with np.errstate(all="ignore"):  # flat splats have a logarithm of -infinity
        return FileContent(CHECKS[row.ending].read(path), Y_UP if row.y_up else Y_DOWN)
