"""The functions of every splat format, by the ending of its row in `formats.format_table`."""

from __future__ import annotations

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
    html,
    ply,
    sog,
    sog_read,
    splat32,
    spz,
    spz_read,
    streamed_sog,
    usd,
    usd_read,
)
from stages.scene import Splats
from stages.scene.morton import morton_order


def _nothing(splats: Splats) -> str:
    return ""


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
        position_loss: (splats) -> what far splats do to the positions, as the end of "the file
            ...", or "".
        size_loss: (splats) -> what happens to splats that are too small, as the end of "the file
            ...", or "".
    """

    write: Callable[..., None]
    read: Callable[[Path], Splats]
    units: Callable[[Path], str] | None = None
    order: Callable[[Splats], NDArray[np.intp]] | None = None
    position_loss: Callable[[Splats], str] = _nothing
    size_loss: Callable[[Splats], str] = _nothing


_GLTF = Codec(gltf.write, gltf_read.read)
_USD = Codec(usd.write, usd_read.read)
CODECS = {
    "ply": Codec(ply.write, ply.read),
    "splat": Codec(splat32.write, splat32.read, order=splat32.order),
    "glb": _GLTF,
    "gltf": _GLTF,
    "usda": _USD,
    "usdc": replace(_USD, units=usd_read.units),
    "usdz": replace(_USD, units=usd_read.units),
    "quantised.glb": Codec(gltf_quantised.write, gltf_read.read, order=gltf_quantised.order),
    "compressed.ply": Codec(compressed_ply.write, compressed_ply.read, order=compressed_ply.order),
    "spz": Codec(
        spz.write, spz_read.read, position_loss=spz.position_loss, size_loss=spz.size_loss
    ),
    "sog": Codec(sog.write, sog_read.read, sog_read.units, morton_order, sog.position_loss),
    "lod-meta.json": Codec(streamed_sog.write, streamed_sog.read, order=streamed_sog.order),
    "html": Codec(html.write, html.read),
}
