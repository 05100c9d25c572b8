"""glTF 2.0 with KHR_gaussian_splatting, as .glb or as .gltf with a .bin beside it: float32.

Linear scales and opacities, quaternions x, y, z, w, SH coefficients, y up. The extension is used
but
not required: a viewer without it shows coloured points.
Specification: KHR_gaussian_splatting in the Khronos glTF registry.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.blocks import blocks
from stages.formats.gltf_file import EXTENSION, Attribute, Negated, write_file
from stages.formats.values import (
    drop_undrawable,
    linear_opacities,
    linear_scales,
    unit_quaternions,
)
from stages.scene import Splats, dc_to_rgb
from stages.scene.flip import SH_SIGNS, flipped


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> int:
    """Write `splats` as `path` (.glb, or .gltf with its .bin); return how many could not be drawn
    and were left out.

    One primitive holds all splats, at the highest SH degree in use: three.js 0.187 and Babylon.js
    9.28 sort and draw each primitive separately, so overlapping splats must share one.

    Raises SplatError when a file cannot be written or a .glb would pass 4 GiB.
    """
    splats, dropped = drop_undrawable(splats)
    splats = splats.with_sh_degree(int(splats.sh_degrees.max(initial=0)))
    primitives = [_attributes(splats)] if len(splats) else []
    write_file(Path(path), primitives, splats, units)
    return dropped


def _attributes(splats: Splats) -> dict[str, Attribute]:
    """The attributes of a primitive. splats: y down, all of one SH degree."""
    y_up = flipped(splats.with_sh_degree(0))
    opacities = linear_opacities(splats)
    colours = np.empty((len(splats), 4), "<u2")
    for rows in blocks(len(splats)):
        linear = fallback_colours(splats.take(rows), opacities[rows])
        colours[rows] = np.rint(65535 * linear)
    return {
        "POSITION": Attribute(y_up.means.astype("<f4"), 3),
        "COLOR_0": Attribute(colours, 4),
        f"{EXTENSION}:ROTATION": Attribute(
            unit_quaternions(y_up.quaternions)[:, [1, 2, 3, 0]].astype("<f4"), 4
        ),
        f"{EXTENSION}:SCALE": Attribute(linear_scales(splats).astype("<f4"), 3),
        f"{EXTENSION}:OPACITY": Attribute(opacities[:, None].astype("<f4"), 1),
        **sh_attributes(splats),
    }


def sh_attributes(splats: Splats) -> dict[str, Attribute]:
    """The SH attributes of `splats` (y down), float32 as the specification requires."""
    found = {}
    for degree in range(splats.sh_degree + 1):
        for i in range(2 * degree + 1):
            k = degree * degree + i
            values = splats.sh[:, k].astype("<f4", copy=False)
            rows = Negated(values) if SH_SIGNS[k] < 0 else values
            found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = Attribute(rows, 3)
    return found


def fallback_colours(splats: Splats, opacities: NDArray[np.float32]) -> NDArray[np.float64]:
    """[N, 4] linear light and opacity in 0..1: COLOR_0, for viewers that only draw points."""
    encoded = np.clip(dc_to_rgb(splats.sh[:, 0].astype(np.float64)), 0, 1)
    return np.concatenate([linear_light(encoded), opacities[:, None]], axis=1)


def linear_light(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light in 0..1 of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
