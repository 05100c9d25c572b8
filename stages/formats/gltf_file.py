"""Writing glTF files: the JSON with buffer views and accessors, and the binary buffer."""

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
from stages.scene import Splats
from stages.scene.flip import flipped

EXTENSION = "KHR_gaussian_splatting"
_COMPONENT_TYPES = {"<f4": 5126, "<i2": 5122, "<u2": 5123, "|u1": 5121}
_GLB_LIMIT_BYTES = (1 << 32) - 1
_ARRAY_BUFFER = 34962
_POINTS = 0


@dataclass(frozen=True)
class Negated:
    """An array that is negated when it is read, which saves a copy."""

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
    """A vertex attribute.

    Attributes:
        rows: [N, W] the values, little-endian; integers are normalised to 0..1 or -1..1.
        width: the number of columns that belong to the attribute; the others pad each row to a
            multiple of 4 bytes (glTF 2.0, section 3.6.2.4).
    """

    rows: Rows
    width: int


def write_file(
    path: Path,
    primitives: list[dict[str, Attribute]],
    splats: Splats,
    units: str,
    *,
    node_scale: float = 1.0,
) -> None:
    """Write one node of splats as `path` (.glb, or .gltf with its .bin), completely or not at all.

    Args:
        path: the file.
        primitives: attributes by name, all with the same number of rows, y up.
        splats: for what asset.extras holds: the origin, in the axes of the file, because positions
            relative to 0 would exceed the precision of float32; whether they are to be drawn with
            opacity compensation, of which KHR_gaussian_splatting says nothing.
        units: "metres" or "arbitrary".
        node_scale: scale of the node.

    Raises SplatError when a file cannot be written or a .glb would exceed 4 GiB.
    """
    more: dict[str, Any] = {"antialiased": True} if splats.draw_settings.antialias else {}
    made_of = asset(units, flipped(splats.take(slice(0))).origin, **more)
    document, arrays = _document(primitives, made_of, node_scale)
    size = sum(array.nbytes for array in arrays)
    if path.suffix.lower() == ".glb":
        write_glb(path, document, arrays, size)
    else:
        _write_pair(path, document, arrays, size)


def _document(
    primitives: list[dict[str, Attribute]], made_of: dict[str, Any], node_scale: float
) -> tuple[dict[str, Any], list[Rows]]:
    """(the JSON, whose buffer has no size and name yet; the arrays in buffer order)."""
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
        "asset": made_of,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if described else []}],
    }
    if not described:  # glTF forbids empty lists; a scene without nodes is valid
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
    """The `asset` of a document.

    Args:
        units: "metres" or "arbitrary".
        origin: [3] in the axes of the file.
        made: the kind of content, in brackets after the name of the generator.
        more: further extras.
    """
    generator = f"splat {VERSION}{made and f' ({made})'}"
    extras: dict[str, Any] = {"units": units, **more}
    if origin.any():
        extras["splat_origin"] = [float(v) for v in origin]
    return {"version": "2.0", "generator": generator, "extras": extras}


def accessor(name: str, attribute: Attribute, view: int) -> dict[str, Any]:
    """The accessor of a vertex attribute in the buffer view of this number."""
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
        described["min"] = [float(v) for v in rows[:].min(axis=0)]
        described["max"] = [float(v) for v in rows[:].max(axis=0)]
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
    """Write a .glb of `document` with one buffer of the `arrays`: `size` bytes in all, each a
    multiple of 4. Raises SplatError when it cannot be written or would exceed 4 GiB."""
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
    """Write .bin and .gltf, the .bin first: a .gltf that exists then has its buffer."""
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
