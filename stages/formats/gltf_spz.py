"""A .glb of SPZ: KHR_gaussian_splatting with KHR_gaussian_splatting_compression_spz_2.

The splats are one .spz of version 3 in a buffer view: the extension asks for what release 2 of the
SPZ library reads. Accessors without a buffer view describe its values. Both extensions are
required, because a viewer without them would show all points at one place.

The text of the draft turns the axes of SPZ (right, up, back) to left, up, front. CesiumJS 1.145,
the implementation that it names, leaves values as they are stored; so do we, and such a file stands
as a .glb does. Specification: KhronosGroup/glTF, pull request 2531.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from stages.formats import spz, spz_read
from stages.formats.gltf import attributes
from stages.formats.gltf_file import EXTENSION, write_file
from stages.scene import Splats
from stages.scene.flip import flipped

# COLOR_0 stands for both
_NOT_DESCRIBED = (f"{EXTENSION}:OPACITY", f"{EXTENSION}:SH_DEGREE_0_COEF_0")


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats`, rounded as `spz.write` does. Raises SplatError when the file cannot be
    written or would pass 4 GiB."""
    write_rounded(path, splats, units=units)


def write_rounded(path: Path, splats: Splats, *, units: str = "arbitrary") -> Splats:
    """Write `splats` as `write` does. Returns them as the file holds them: rounded, y down."""
    packed = io.BytesIO()
    spz.pack(packed, splats)
    payload = np.frombuffer(packed.getvalue(), np.uint8)
    held = flipped(spz_read.unpack(packed, len(payload))[0], reuse=True)
    described = attributes(held, colour_type="u1")
    for name in _NOT_DESCRIBED:
        del described[name]
    primitives = [described] if len(splats) else []
    write_file(Path(path), primitives, splats, units, payload=payload)
    return held
