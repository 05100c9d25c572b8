"""glTF 2.0 with KHR_gaussian_splatting, as .glb or as .gltf with a .bin beside it: float32.

Linear scales and opacities, quaternions x, y, z, w, SH coefficients, y up. The extension is used
but not required: a viewer without it shows coloured points.
Specification: KHR_gaussian_splatting in the Khronos glTF registry.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.row_slices import row_slices
from stages.formats.gltf_file import EXTENSION, Attribute, write_file
from stages.formats.values import (
    linear_opacities,
    linear_scales,
    unit_quaternions,
)
from stages.scene import Splats, dc_to_rgb
from stages.scene.flip import SH_SIGNS, flipped
from stages.scene.light import linear_light


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats` as `path` (.glb, or .gltf with its .bin).

    One primitive holds all splats, at the highest SH degree in use: three.js 0.187 and Babylon.js
    9.28 sort and draw each primitive separately, so overlapping splats must share one.

    Raises SplatError when a file cannot be written or a .glb would pass 4 GiB.
    """
    splats = splats.with_sh_degree(int(splats.sh_degrees.max(initial=0)))
    primitives = [attributes(splats)] if len(splats) else []
    write_file(Path(path), primitives, splats, units)


def floats(name: str, values: NDArray[np.float32]) -> Attribute:
    """An attribute as float32."""
    return Attribute(values.astype("<f4"), values.shape[1])


def attributes(
    splats: Splats,
    encoded: Callable[[str, NDArray[np.float32]], Attribute] = floats,
    colour_type: str = "<u2",
    unit: float = 1.0,
) -> dict[str, Attribute]:
    """The attributes of a primitive.

    Args:
        splats: y down, all of one SH degree.
        encoded: (name, values [N, W]) -> the attribute ROTATION, SCALE or OPACITY.
        colour_type: integers of the fallback colours.
        unit: positions are divided by it.
    """
    y_up = flipped(splats.with_sh_degree(0))
    opacities = linear_opacities(splats)
    colours = np.empty((len(splats), 4), colour_type)
    for rows in row_slices(len(splats)):
        linear = fallback_colours(splats.take(rows), opacities[rows])
        colours[rows] = np.rint(np.iinfo(colours.dtype).max * linear)
    values = {
        "ROTATION": unit_quaternions(y_up.quaternions)[:, [1, 2, 3, 0]],
        "SCALE": linear_scales(splats),
        "OPACITY": opacities[:, None],
    }
    return {
        "POSITION": floats("POSITION", y_up.means / np.float32(unit)),
        "COLOR_0": Attribute(colours, 4),
        **{f"{EXTENSION}:{name}": encoded(name, array) for name, array in values.items()},
        **_sh_attributes(splats),
    }


def _sh_attributes(splats: Splats) -> dict[str, Attribute]:
    """The SH attributes of `splats` (y down), float32 as the specification requires."""
    attributes = {}
    for degree in range(splats.sh_degree + 1):
        for i in range(2 * degree + 1):
            k = degree * degree + i
            rows = splats.sh[:, k].astype("<f4", copy=False)
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"
            attributes[name] = Attribute(rows, 3, negated=SH_SIGNS[k] < 0)
    return attributes


def fallback_colours(splats: Splats, opacities: NDArray[np.float32]) -> NDArray[np.floating]:
    """[N, 4] linear light and opacity in 0..1: COLOR_0, for viewers that only draw points."""
    encoded = np.clip(dc_to_rgb(splats.sh[:, 0].astype(np.float64)), 0, 1)
    return np.concatenate([linear_light(encoded), opacities[:, None]], axis=1)
