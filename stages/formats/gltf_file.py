"""The frame of a glTF file of splats: its JSON, buffer views and accessors, and writing it."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.blocks import reported_blocks
from stages.base.distribution import VERSION
from stages.base.errors import Family, SplatError

EXTENSION = "KHR_gaussian_splatting"
_COMPONENT_TYPES = {"<f4": 5126, "<i2": 5122, "<u2": 5123, "|u1": 5121}
_GLB_LIMIT_BYTES = (1 << 32) - 1
_ARRAY_BUFFER = 34962
_POINTS = 0


@dataclass(frozen=True)
class Negated:
    """An array whose values change their sign when they are looked at, so that the splats need no
    second copy of it."""

    array: NDArray[Any]

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return -self.array[rows]

    dtype = property(lambda self: self.array.dtype)
    nbytes = property(lambda self: self.array.nbytes)
    shape = property(lambda self: self.array.shape)


Rows = NDArray[Any] | Negated


@dataclass(frozen=True)
class Attribute:
    """rows [N, W]: what the buffer holds, little-endian, in memory in any order; integers stand
    for 0..1 or -1..1. width: how many of the W columns are the attribute's; the others fill a row
    up to a multiple of 4 bytes, as glTF 2.0 wants it (section 3.6.2.4)."""

    rows: Rows
    width: int


def write_file(
    path: Path,
    primitives: list[dict[str, Attribute]],
    origin: NDArray[np.float64],
    units: str,
    *,
    node_scale: float = 1.0,
) -> None:
    """Write one node of splats as `path` (.glb, or .gltf with its .bin), whole or not at all.

    primitives: attributes by name, each with as many rows; upright. Positions stay relative to
    `origin`, which float32 could not hold; asset.extras says it, in the file's axes.
    Raises SplatError when a file cannot be written or a .glb would pass 4 GiB.
    """
    document, arrays = _document(primitives, origin, units, node_scale)
    size = sum(array.nbytes for array in arrays)
    if path.suffix.lower() == ".glb":
        write_glb(path, document, arrays, size)
    else:
        _write_pair(path, document, arrays, size)


def _document(
    primitives: list[dict[str, Attribute]],
    origin: NDArray[np.float64],
    units: str,
    node_scale: float,
) -> tuple[dict[str, Any], list[Rows]]:
    """(the JSON, its first buffer still without size and name; the arrays in buffer order)."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    arrays: list[Rows] = []
    offset = 0
    described = []
    for attributes in primitives:
        names = {}
        for name, attribute in attributes.items():
            names[name] = len(accessors)
            accessors.append(accessor(name, attribute, len(views)))
            array = attribute.rows
            view = {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": array.nbytes,
                "target": _ARRAY_BUFFER,
            }
            if array.shape[1] > attribute.width:
                view["byteStride"] = array.nbytes // len(array)
            views.append(view)
            arrays.append(array)
            offset += array.nbytes
        described.append(_primitive(names))
    document: dict[str, Any] = {
        "asset": asset(units, origin),
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if described else []}],
    }
    if not described:  # glTF forbids empty lists: a scene without nodes is how it says "nothing"
        document["scenes"] = [{"name": "empty"}]
        return document, []
    node: dict[str, Any] = {"mesh": 0, "name": "splats"}
    if node_scale != 1:
        node["scale"] = [node_scale] * 3
    document |= {
        "nodes": [node],
        "meshes": [{"primitives": described, "name": "splats"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{}],
    }
    return document, arrays


def asset(units: str, origin: NDArray[np.float64], made: str = "", **more: Any) -> dict[str, Any]:
    """The `asset` of a document of ours. origin [3]: in the file's axes. made: what the generator
    made, in brackets after its name. more: for the extras."""
    generator = f"splat {VERSION}{made and f' ({made})'}"
    extras: dict[str, Any] = {"units": units, **more}
    if origin.any():
        extras["splat_origin"] = [float(v) for v in origin]
    return {"version": "2.0", "generator": generator, "extras": extras}


def accessor(name: str, attribute: Attribute, view: int) -> dict[str, Any]:
    """Of a vertex attribute in the buffer view numbered `view`."""
    rows, width = attribute.rows, attribute.width
    described: dict[str, Any] = {
        "bufferView": view,
        "componentType": _COMPONENT_TYPES[rows.dtype.str],
        "count": len(rows),
        "type": "SCALAR" if width == 1 else f"VEC{width}",
    }
    if rows.dtype.kind in "iu":
        described["normalized"] = True
    if name == "POSITION":
        every = rows[:]
        described["min"] = [float(v) for v in every.min(axis=0)]
        described["max"] = [float(v) for v in every.max(axis=0)]
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


def write_glb(path: Path, document: dict[str, Any], arrays: Sequence[Rows], size: int) -> None:
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
            _write_arrays(file, arrays)


def _write_pair(path: Path, document: dict[str, Any], arrays: Sequence[Rows], size: int) -> None:
    """The .bin first: whoever finds the .gltf finds what it names."""
    binary = path.with_suffix(".bin")
    if arrays:
        document["buffers"] = [{"uri": quote(binary.name), "byteLength": size}]
        with replacing(binary) as temporary, temporary.open("wb") as file:
            _write_arrays(file, arrays)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _write_arrays(file: BinaryIO, arrays: Sequence[Rows]) -> None:
    for array in arrays:
        for rows in reported_blocks(len(array)):
            file.write(np.ascontiguousarray(array[rows]).data)
