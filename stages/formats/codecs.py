"""The functions of every splat format, by the ending of its row in `formats.format_table`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.formats import (
    compressed_ply,
    gltf,
    gltf_quantised,
    gltf_read,
    gltf_spz,
    html,
    ksplat,
    ply,
    sog,
    sog_read,
    splat32,
    spz,
    spz_read,
    streamed_sog,
    tileset,
    usd,
    usd_read,
)
from stages.scene import Splats
from stages.scene.morton import morton_order


@dataclass(frozen=True)
class Codec:
    """The functions of one format.

    Attributes:
        write: (path, splats, *, units), with drawable splats. It also takes `views` if the row
            says `takes_views`, and `coarser` if it is `streamed`.
        read: (path) -> Splats, y down; raises BadFileError, or what damaged bytes cause.
        units: (path) -> the units that a file declares, or ""; raises as `read`. None for formats
            whose files declare them in text at their start, or not at all.
        order: (splats) -> [N] the row of `splats` that each row of the file comes from; None if the
            format keeps the order.
        parts: (path) -> by relative path, all files of a streamed asset.
        move: (from, to) moves a streamed asset, which replaces the one there.
        positions: how positions are held, as the end of "the format ...".
        log_sizes: the least and the greatest ln of a standard deviation that it holds.
        most_sh: the largest magnitude of a coefficient above degree 0 that it holds.
    """

    write: Callable[..., None]
    read: Callable[[Path], Splats]
    units: Callable[[Path], str] | None = None
    order: Callable[[Splats], NDArray[np.intp]] | None = None
    parts: Callable[[Path], dict[str, Path]] | None = None
    move: Callable[[Path, Path], None] | None = None
    positions: str = "holds positions of 32 bits, in coarser steps the farther from zero they are"
    log_sizes: tuple[float, float] = (-math.inf, math.inf)
    most_sh: float = math.inf

    def size_loss(self, splats: Splats) -> tuple[str, str]:
        """What sizes it holds, as the end of "the format ...", and the advice that brings those of
        `splats` into this range; ("", "") if it holds them all."""
        low, high = self.log_sizes
        largest = splats.log_scales.max(axis=1, initial=-np.inf)
        if not len(largest) or (low <= largest.min() and largest.max() <= high):
            return "", ""
        why = f"holds sizes from {math.exp(low):.2g} to {math.exp(high):.3g} units"
        few, most = np.quantile(largest, _FEW), largest.max()
        tens = [math.floor((high - most) / _TEN), math.ceil((low - few) / _TEN)]
        power = min(tens[0], 0) or max(tens[1], 0)
        if not power or few + power * _TEN < low or most + power * _TEN > high:
            return why, ""
        return why, f"`splat edit --scale 1e{power}` brings them into that range"


_GLTF = Codec(gltf.write, gltf_read.read)
_FEW, _TEN = 0.01, math.log(10)  # a share of splats that may be too small to be seen
_USD = Codec(usd.write, usd_read.read)
_SIZES = (-compressed_ply.LOG_SCALE_LIMIT, compressed_ply.LOG_SCALE_LIMIT)
_SPZ = Codec(
    spz.write,
    spz_read.read,
    positions="holds positions of 24 bits, and moves what lies farther out towards the origin",
    log_sizes=spz.LOG_SIZES,
    most_sh=1.0,
)
CODECS = {
    "ply": Codec(ply.write, ply.read),
    "splat": Codec(splat32.write, splat32.read, order=splat32.order),
    "glb": _GLTF,
    "gltf": _GLTF,
    "usda": _USD,
    "usdc": replace(_USD, units=usd_read.units),
    "usdz": replace(_USD, units=usd_read.units),
    "quantised.glb": Codec(gltf_quantised.write, gltf_read.read, order=gltf_quantised.order),
    "spz.glb": replace(_SPZ, write=gltf_spz.write, read=gltf_read.read),
    "compressed.ply": Codec(
        compressed_ply.write,
        compressed_ply.read,
        order=compressed_ply.order,
        positions="holds positions of 10 and 11 bits in the range of each 256",
        log_sizes=_SIZES,
        most_sh=compressed_ply.SH_LIMIT,
    ),
    "spz": _SPZ,
    "v4.spz": replace(_SPZ, write=spz.write_4),
    "sog": Codec(
        *(sog.write, sog_read.read, sog_read.units, morton_order),
        positions="holds positions of 16 bits in the range of all",
        log_sizes=_SIZES,
    ),
    "lod-meta.json": Codec(
        streamed_sog.write,
        streamed_sog.read,
        order=streamed_sog.order,
        parts=streamed_sog.parts_of,
        move=streamed_sog.move,
        positions="holds positions of 16 bits in the range of each chunk",
        log_sizes=_SIZES,
    ),
    "tileset.json": replace(
        _SPZ,
        write=tileset.write,
        read=tileset.read,
        order=tileset.order,
        parts=tileset.parts_of,
        move=tileset.move,
    ),
    "html": Codec(html.write, html.read),
    "ksplat": Codec(ksplat.write, ksplat.read),
}
