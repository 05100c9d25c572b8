"""glTF 2.0 with KHR_gaussian_splatting, as .glb or as .gltf with a .bin beside it.

Linear scales and opacities, quaternions x, y, z, w, raw SH, y up: the splats are turned upright.
The extension is used but not required: a viewer without it shows coloured points.
Specification: KHR_gaussian_splatting in the Khronos glTF registry.
"""

from __future__ import annotations

import importlib.metadata
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from stages.formats.gltf_read import read
from stages.formats.rows import (
    kept_rows,
    linear_opacities,
    linear_scales,
    unit_quaternions,
)
from stages.formats.turn import turned
from stages.run.atomic import replacing
from stages.run.errors import Family, SplatError
from stages.scene import Splats, dc_to_rgb

__all__ = ["read", "write"]

EXTENSION = "KHR_gaussian_splatting"
_COMPONENT_TYPES = {"<f4": 5126, "<u2": 5123}
_GLB_LIMIT_BYTES = (1 << 32) - 1
_ARRAY_BUFFER = 34962
_POINTS = 0


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", split_degrees: bool = False
) -> int:
    """Write `splats` as `path` (.glb, or .gltf with its .bin); return how many could not be drawn
    and were left out.

    Positions stay relative to `splats.origin`, which float32 could not hold; asset.extras says it
    in the file's axes.

    split_degrees: one primitive for each SH degree in use, so that splats without view-dependent
    colour do not pay for it. Smaller, but three.js 0.187 and Babylon.js 9.28 sort and draw each
    primitive by itself, so that splats of different degrees are blended in the wrong order.

    Raises SplatError when a file cannot be written or a .glb would pass 4 GiB.
    """
    path = Path(path)
    splats, dropped = kept_rows(splats)
    if not split_degrees:
        highest = int(splats.sh_degrees.max(initial=0))
        splats = replace(splats, sh_degrees=np.full(len(splats), highest, np.uint8))
    attributes = list(_primitives(turned(splats)))
    document, arrays = _document(attributes, splats, units)
    size = sum(array.nbytes for array in arrays)
    if path.suffix.lower() == ".glb":
        write_glb(path, document, arrays, size)
    else:
        _write_pair(path, document, arrays, size)
    return dropped


def _primitives(splats: Splats) -> Iterator[dict[str, NDArray[Any]]]:
    """Attributes of one primitive after the other, by rising degree."""
    for degree in range(splats.sh_degree + 1):
        chosen = splats.take(np.flatnonzero(splats.sh_degrees == degree))
        if not len(chosen):
            continue
        opacities = linear_opacities(chosen)
        attributes: dict[str, NDArray[Any]] = {
            "POSITION": chosen.means.astype("<f4"),
            "COLOR_0": _fallback_colours(chosen, opacities),
            f"{EXTENSION}:ROTATION": unit_quaternions(chosen.quaternions)[:, [1, 2, 3, 0]],
            f"{EXTENSION}:SCALE": linear_scales(chosen),
            f"{EXTENSION}:OPACITY": opacities,
        }
        for band in range(degree + 1):
            for i in range(2 * band + 1):
                name = f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}"
                attributes[name] = chosen.sh[:, band * band + i].astype("<f4")
        yield attributes


def _fallback_colours(splats: Splats, opacities: NDArray[np.float32]) -> NDArray[np.uint16]:
    """[N, 4] for viewers that only draw points: glTF wants linear light."""
    encoded = np.clip(dc_to_rgb(splats.sh[:, 0].astype(np.float64)), 0, 1)
    colours = np.concatenate([linear_light(encoded), opacities[:, None]], axis=1)
    return np.rint(65535 * colours).astype("<u2")


def linear_light(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB values in 0..1 as linear light in 0..1 (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _document(
    primitives: list[dict[str, NDArray[Any]]], splats: Splats, units: str
) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """(the JSON, its first buffer still without size and name; the arrays in buffer order)."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    arrays: list[NDArray[Any]] = []
    offset = 0
    described = []
    for attributes in primitives:
        names = {}
        for name, array in attributes.items():
            names[name] = len(accessors)
            accessors.append(accessor(name, array, len(views)))
            views.append(
                {
                    "buffer": 0,
                    "byteOffset": offset,
                    "byteLength": array.nbytes,
                    "target": _ARRAY_BUFFER,
                }
            )
            arrays.append(np.ascontiguousarray(array))
            offset += array.nbytes
        described.append(_primitive(names))
    version = importlib.metadata.version("splat")
    extras: dict[str, Any] = {"units": units}
    if splats.origin.any():
        extras["splat_origin"] = [float(v) for v in turned(splats).origin]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"splat {version}", "extras": extras},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if described else []}],
    }
    if not described:  # glTF forbids empty lists: a scene without nodes is how it says "nothing"
        document["scenes"] = [{"name": "empty"}]
        return document, []
    document |= {
        "nodes": [{"mesh": 0, "name": "splats"}],
        "meshes": [{"primitives": described, "name": "splats"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{}],
    }
    return document, arrays


def accessor(name: str, array: NDArray[Any], view: int) -> dict[str, Any]:
    """Of a vertex attribute; integers are read as shares of the largest."""
    kind = {1: "SCALAR", 2: f"VEC{array.shape[-1]}"}[array.ndim]
    described: dict[str, Any] = {
        "bufferView": view,
        "componentType": _COMPONENT_TYPES[array.dtype.newbyteorder("<").str],
        "count": len(array),
        "type": kind,
    }
    if array.dtype.kind == "u":
        described["normalized"] = True
    if name == "POSITION":
        described["min"] = [float(v) for v in array.min(axis=0)]
        described["max"] = [float(v) for v in array.max(axis=0)]
    return described


def _primitive(names: dict[str, int]) -> dict[str, Any]:
    return {
        "attributes": names,
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }


def write_glb(path: Path, document: dict[str, Any], arrays: list[NDArray[Any]], size: int) -> None:
    """`document` and, as its one buffer, `arrays` one after the other: `size` bytes in all, a
    multiple of 4 each. Raises SplatError when it cannot be written or would pass 4 GiB."""
    if arrays:
        document["buffers"] = [{"byteLength": size}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + (8 + size if arrays else 0)
    if total > _GLB_LIMIT_BYTES:
        raise SplatError(
            "export-glb-too-large",
            given=f"{path} would take {total / 2**30:.1f} GiB.",
            wanted="A .glb cannot be larger than 4 GiB.",
            hint="Export .gltf or .ply instead, or train with fewer splats.",
            family=Family.USAGE,
        )
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        if arrays:  # every array is a multiple of 4 bytes, so the chunk needs no padding
            file.write(struct.pack("<I4s", size, b"BIN\0"))
            for array in arrays:
                file.write(array.data)


def _write_pair(
    path: Path, document: dict[str, Any], arrays: list[NDArray[Any]], size: int
) -> None:
    """The .bin first: whoever finds the .gltf finds what it names."""
    binary = path.with_suffix(".bin")
    if arrays:
        document["buffers"] = [{"uri": quote(binary.name), "byteLength": size}]
        with replacing(binary) as temporary, temporary.open("wb") as file:
            for array in arrays:
                file.write(array.data)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
