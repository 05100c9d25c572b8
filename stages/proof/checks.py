"""How a splat file is checked by code that did not write it: one row for each format.

A row is found by the ending of the file's format in `stages.formats.table`. To add one, write the
independent reader in `independent_readers` or `independent_packed` and the byte breakdown in
`byte_breakdown`, and name both here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.base.bad_files import reading
from stages.formats import format_of
from stages.proof import byte_breakdown, independent_packed, independent_readers
from stages.proof.byte_breakdown import ByteBreakdown
from stages.proof.content import Y_DOWN, Y_UP, FileContent
from stages.scene import Splats


@dataclass(frozen=True)
class Checks:
    """The checks of one format.

    Attributes:
        read: (path) -> Splats in the file's axes. It shares no code with the writer and may raise
            anything.
        byte_breakdown: (path) -> how many bytes each attribute takes.
        validate: (path) -> errors that another program's validator finds.
    """

    read: Callable[[Path], Splats]
    byte_breakdown: Callable[[Path], ByteBreakdown]
    validate: Callable[[Path], list[str]] = lambda path: []


_PLY = Checks(independent_readers.ply, byte_breakdown.ply)
_GLTF = Checks(independent_readers.gltf, byte_breakdown.gltf)
_USD = Checks(independent_readers.usd, byte_breakdown.usd, independent_readers.usd_errors)
CHECKS = {
    "ply": _PLY,
    "splat": Checks(independent_readers.splat, byte_breakdown.splat),
    "glb": _GLTF,
    "gltf": _GLTF,
    "usda": _USD,
    "usdc": _USD,
    "usdz": _USD,
    "quantised.glb": _GLTF,
    "compressed.ply": replace(_PLY, read=independent_packed.compressed_ply),
    "spz": Checks(independent_packed.spz, byte_breakdown.spz),
    "sog": Checks(independent_packed.sog, byte_breakdown.sog),
    "lod-meta.json": Checks(independent_packed.streamed_sog, byte_breakdown.streamed_sog),
    "html": Checks(independent_readers.html, byte_breakdown.html),
}


def read_back(path: Path) -> FileContent:
    """What another program finds in the file. Raises whatever its parser raises: a file that was
    just written must be readable."""
    row = format_of(path)
    with np.errstate(all="ignore"):  # flat splats have a logarithm of -infinity
        return FileContent(CHECKS[row.ending].read(path), Y_UP if row.y_up else Y_DOWN)


def byte_breakdown_of(path: Path) -> ByteBreakdown:
    """Where the bytes of a splat file are, "other" for what belongs to no attribute. Raises
    SplatError as `format_of`, or "splats-unreadable"."""
    path = Path(path)
    row = format_of(path)
    with reading(path):
        found = CHECKS[row.ending].byte_breakdown(path)
    other = row.size_bytes(path) - sum(found.parts.values())
    if found.unknown or found.unpacked or other <= 0:
        return found
    return replace(found, parts={**found.parts, "other": other})
