"""Writing glTF files: the JSON with buffer views and accessors, and the binary buffer."""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.distribution import VERSION
from stages.base.errors import UsageError
from stages.base.row_slices import row_slices
from stages.formats.first_camera import NAME, pose_of
from stages.formats.json_fields import location_fields
from stages.scene import Camera, Splats
from stages.scene.draw_settings import near_plane_of
from stages.scene.flip import flipped
from stages.scene.place import EarthPlace
from stages.scene.rotations import quaternions_of

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
_COMPONENT_TYPES = {"<f4": 5126, "<i2": 5122, "<u2": 5123, "|u1": 5121, "<u4": 5125}
_GLB_LIMIT_BYTES = (1 << 32) - 1
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_POINTS = 0
_DIGITS = 9  # of rotations, whose last digits depend on the machine


@dataclass(frozen=True)
class Attribute:
    """A vertex attribute.

    Attributes:
        rows: [N, W] the values, little-endian; integers are normalised to 0..1 or -1..1.
        width: the number of columns that belong to the attribute; the others pad each row to a
            multiple of 4 bytes (glTF 2.0, section 3.6.2.4).
        negated: whether the rows are negated when they are written, which saves a copy.
    """

    rows: NDArray[Any]
    width: int
    negated: bool = False


def write_file(
    path: Path,
    primitives: list[dict[str, Attribute]],
    splats: Splats,
    units: str,
    *,
    node_scale: float = 1.0,
    payload: NDArray[np.uint8] | None = None,
) -> None:
    """Write a node of splats, and one of their first camera if it is known, as `path` (.glb, or
    .gltf with its .bin), completely or not at all.

    Args:
        path: the file.
        primitives: attributes by name, all with the same number of rows, y up.
        splats: for the camera, and for what asset.extras holds: origin and place, in the axes of
            the file, because positions relative to 0 would exceed the precision of float32; whether
            they are to be drawn with opacity compensation: KHR_gaussian_splatting has no field for
            it.
        units: "metres" or "arbitrary".
        node_scale: scale of the node.
        payload: the attributes of the only primitive as the bytes of a .spz; they are then
            described and not stored.

    Raises SplatError when a file cannot be written or a .glb would exceed 4 GiB.
    """
    more: dict[str, Any] = {"antialiased": True} if splats.draw_settings.antialias else {}
    y_up = flipped(splats.take(slice(0)))
    made_of = asset(units, y_up.origin, y_up.place, **more)
    document = _document(primitives, made_of, node_scale)
    if primitives and y_up.first_camera is not None:
        near = splats.draw_settings.near or near_plane_of(splats.means)
        _add_camera(document, y_up.first_camera, near)
    written = [attribute for attributes in primitives for attribute in attributes.values()]
    if written and payload is not None:
        _compress(document, len(payload))
        written = [Attribute(np.pad(payload, (0, -len(payload) % 4)).reshape(-1, 4), 4)]
    write = write_glb if path.suffix.lower() == ".glb" else _write_pair
    write(path, document, written)


def _document(
    primitives: list[dict[str, Attribute]], made_of: dict[str, Any], node_scale: float
) -> dict[str, Any]:
    """The JSON, whose buffer has no size and name yet."""
    written: list[tuple[str, Attribute]] = []
    described = []
    for attributes in primitives:
        described.append(_primitive({n: len(written) + i for i, n in enumerate(attributes)}))
        written += attributes.items()
    document: dict[str, Any] = {
        "asset": made_of,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if described else []}],
    }
    if not described:  # glTF forbids empty lists; a scene without nodes is valid
        return document | {"scenes": [{"name": "empty"}]}
    node: dict[str, Any] = {"mesh": 0, "name": "splats"}
    if node_scale != 1:
        node["scale"] = [node_scale] * 3
    return document | {
        "nodes": [node],
        "meshes": [{"primitives": described, "name": "splats"}],
        **buffer_fields(written),
    }


def _compress(document: dict[str, Any], size: int) -> None:
    """Let a payload of `size` bytes stand for the attributes of the only primitive. CesiumJS 1.145
    takes it from the first buffer view, whichever is named."""
    for accessor in document["accessors"]:
        del accessor["bufferView"]
    document["bufferViews"] = [{"buffer": 0, "byteLength": size}]
    (primitive,) = document["meshes"][0]["primitives"]
    primitive["extensions"][EXTENSION]["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
    document["extensionsUsed"] = document["extensionsRequired"] = [EXTENSION, SPZ_EXTENSION]


def _add_camera(document: dict[str, Any], camera: Camera, near: float) -> None:
    """Add a camera, in the axes of the file, to the scene. near: its near plane."""
    pose = pose_of(camera)
    lens = {
        "yfov": 2 * math.atan(camera.height / camera.fy / 2),
        "aspectRatio": camera.width / camera.fx / (camera.height / camera.fy),
        "znear": near,
    }
    document["cameras"] = [{"type": "perspective", "perspective": lens, "name": NAME}]
    turn = quaternions_of(pose[:3, :3])[[1, 2, 3, 0]]
    document["scenes"][0]["nodes"].append(len(document["nodes"]))
    document["nodes"].append(
        {
            "camera": 0,
            "name": NAME,
            "rotation": [round(float(v), _DIGITS) for v in turn],
            "translation": pose[:3, 3].tolist(),
        }
    )


def buffer_fields(written: Iterable[tuple[str, Attribute]]) -> dict[str, Any]:
    """Accessors, buffer views and the buffer, which has no size and name yet, of vertex attributes
    by name and of indices (name ""), in their order in the buffer."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    offset = 0
    for name, attribute in written:
        accessors.append(_accessor(name, attribute, len(views)))
        views.append(_buffer_view(name, attribute, offset))
        offset += attribute.rows.nbytes
    return {"accessors": accessors, "bufferViews": views, "buffers": [{}]}


def asset(
    units: str,
    origin: NDArray[np.float64],
    place: EarthPlace | None,
    made: str = "",
    **more: Any,
) -> dict[str, Any]:
    """The `asset` of a document.

    Args:
        units: "metres" or "arbitrary".
        origin, place: of the scene, in the axes of the file.
        made: the kind of content, in brackets after the name of the generator.
        more: further extras.
    """
    generator = f"splat {VERSION}{made and f' ({made})'}"
    extras: dict[str, Any] = {"units": units, **more}
    return {
        "version": "2.0",
        "generator": generator,
        "extras": extras | location_fields(origin, place),
    }


def _buffer_view(name: str, attribute: Attribute, offset: int) -> dict[str, Any]:
    """The buffer view of an attribute whose bytes start at `offset`."""
    rows = attribute.rows
    target = _ARRAY_BUFFER if name else _ELEMENT_ARRAY_BUFFER
    view = {"buffer": 0, "byteOffset": offset, "byteLength": rows.nbytes, "target": target}
    if rows.shape[1] > attribute.width:
        view["byteStride"] = rows.nbytes // len(rows)
    return view


def _accessor(name: str, attribute: Attribute, view: int) -> dict[str, Any]:
    """The accessor of an attribute in the buffer view of this number."""
    rows, width = attribute.rows, attribute.width
    described: dict[str, Any] = {
        "bufferView": view,
        "componentType": _COMPONENT_TYPES[rows.dtype.str],
        "count": len(rows),
        "type": "SCALAR" if width == 1 else f"VEC{width}",
    }
    if name and rows.dtype.kind in "iu":
        described["normalized"] = True
    if name == "POSITION":
        described["min"] = [float(v) for v in rows.min(axis=0)]
        described["max"] = [float(v) for v in rows.max(axis=0)]
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


def write_glb(path: Path, document: dict[str, Any], attributes: Sequence[Attribute]) -> None:
    """Write a .glb of `document` with one buffer of the rows of `attributes`, each a multiple of 4
    bytes. Raises SplatError when it cannot be written or would exceed 4 GiB."""
    size = _size(attributes)
    if attributes:
        document["buffers"] = [{"byteLength": size}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + (8 + size if attributes else 0)
    if total > _GLB_LIMIT_BYTES:
        raise UsageError(
            "export-glb-too-large",
            given=f"{path} would take {total / 2**30:.1f} GiB.",
            wanted="A .glb cannot be larger than 4 GiB.",
            hint="Export .gltf or .ply instead, or train with fewer splats.",
        )
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        if attributes:  # all are multiples of 4 bytes, so the chunk needs no padding
            file.write(struct.pack("<I4s", size, b"BIN\0"))
            _write_rows(file, attributes)


def _write_pair(path: Path, document: dict[str, Any], attributes: Sequence[Attribute]) -> None:
    """Write .bin and .gltf, the .bin first: a .gltf that exists then has its buffer."""
    binary = path.with_suffix(".bin")
    if attributes:
        document["buffers"] = [{"uri": quote(binary.name), "byteLength": _size(attributes)}]
        with replacing(binary) as temporary, temporary.open("wb") as file:
            _write_rows(file, attributes)
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def refuse_taken_buffer(path: Path) -> None:
    """Raise SplatError "gltf-buffer-taken" where the .bin of a .gltf that is to be written exists
    and is not the buffer of the .gltf there: it may be anything, such as COLMAP's points3D.bin."""
    binary = path.with_suffix(".bin")
    if os.path.lexists(binary) and binary.name not in _buffer_names(path):
        raise UsageError(
            "gltf-buffer-taken",
            given=f"{binary} exists and is not the buffer of an earlier {path.name}.",
            wanted="A name whose .bin overwrites nothing.",
            hint="Name another file, or move that one away.",
        )


def _buffer_names(path: Path) -> list[str]:
    """The names that the buffers of a .gltf have; none where there is no such file."""
    try:
        buffers = json.loads(path.read_text(encoding="utf-8"))["buffers"]
        return [unquote(buffer["uri"]) for buffer in buffers if "uri" in buffer]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return []


def _size(attributes: Sequence[Attribute]) -> int:
    return sum(attribute.rows.nbytes for attribute in attributes)


def _write_rows(file: BinaryIO, attributes: Sequence[Attribute]) -> None:
    for attribute in attributes:
        for part in row_slices(len(attribute.rows)):
            rows = attribute.rows[part]
            file.write(np.ascontiguousarray(-rows if attribute.negated else rows).data)
