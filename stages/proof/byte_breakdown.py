"""How many bytes of a splat file each attribute takes."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.formats import format_of, spz_read
from stages.formats.html import unzipped
from stages.formats.ply_header import Header, read_header
from stages.formats.splat32 import RECORD

_PLY = {
    **dict.fromkeys(("x", "y", "z"), "positions"),
    **dict.fromkeys(("nx", "ny", "nz"), "normals"),
    "opacity": "opacities",
    "packed_position": "positions",
    "packed_rotation": "rotations",
    "packed_scale": "scales",
    "packed_color": "colours, opacities",
}
_PLY_STARTS = {"f_dc_": "colours", "f_rest_": "SH", "scale_": "scales", "rot_": "rotations"}
_SPLAT = {
    "mean": "positions",
    "scale": "scales",
    "rgba": "colours, opacities",
    "quaternion": "rotations",
}
_GLTF = {"POSITION": "positions", "COLOR_0": "fallback colours"}
_GLTF_ENDS = {"ROTATION": "rotations", "SCALE": "scales", "OPACITY": "opacities"}
_GLTF_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5126: 4}
_GLTF_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SPZ = ("positions", "opacities", "colours", "scales", "rotations", "SH")
_SOG = {"means": "positions", "quats": "rotations", "sh0": "colours, opacities", "shN": "SH"}


@dataclass(frozen=True)
class ByteBreakdown:
    """Where the bytes of a file are.

    Attributes:
        parts: bytes by attribute.
        unpacked: whether they are counted before the compression that packs all of them together.
        unknown: why there are no parts; "" if there are.
    """

    parts: dict[str, int]
    unpacked: bool = False
    unknown: str = ""


def ply(path: Path) -> ByteBreakdown:
    with path.open("rb") as file:
        return ByteBreakdown(_ply_columns(read_header(file)))


def html(path: Path) -> ByteBreakdown:
    """Of the .ply inside."""
    start = next(unzipped(path))  # some megabytes: longer than any header
    return ByteBreakdown(_ply_columns(read_header(io.BytesIO(start))), unpacked=True)


def usd(path: Path) -> ByteBreakdown:
    why = "USD compresses values and does not say how many bytes each attribute takes"
    return ByteBreakdown({}, unknown=why)


def _ply_columns(header: Header) -> dict[str, int]:
    parts: Counter[str] = Counter()
    for element in header.elements if header.encoding != "ascii" else ():
        for name, kind in element.properties:
            start = next((what for s, what in _PLY_STARTS.items() if name.startswith(s)), "")
            what = _PLY.get(name) or start or "other properties"
            what = "ranges" if element.name == "chunk" else what
            parts[what] += element.count * int(kind[1])
    return dict(parts)


def splat(path: Path) -> ByteBreakdown:
    count = path.stat().st_size // RECORD.itemsize
    fields: Any = RECORD.fields or {}
    return ByteBreakdown({_SPLAT[name]: count * kind[0].itemsize for name, kind in fields.items()})


def gltf(path: Path) -> ByteBreakdown:
    with path.open("rb") as file:
        text = file.read(20)
        if text[:4] == b"glTF":
            text = file.read(struct.unpack_from("<I", text, 12)[0])
        else:
            text += file.read()
    document = json.loads(text)
    parts: Counter[str] = Counter()
    for mesh in document.get("meshes", []):
        for primitive in mesh["primitives"]:
            for name, index in primitive["attributes"].items():
                accessor = document["accessors"][index]
                element = _GLTF_BYTES[accessor["componentType"]] * _GLTF_WIDTHS[accessor["type"]]
                end = name.rpartition(":")[2]
                what = _GLTF.get(name) or _GLTF_ENDS.get(end) or "SH"
                what = "colours" if end == "SH_DEGREE_0_COEF_0" else what
                parts[what] += element * accessor["count"]
    return ByteBreakdown(dict(parts))


def spz(path: Path) -> ByteBreakdown:
    sizes = spz_read.packed_sizes(path)
    if sizes:
        return ByteBreakdown(dict(zip(_SPZ, sizes, strict=False)))
    with gzip.open(path) as file:
        head = spz_read.Header.of(file.read(spz_read.HEADER.size))
    widths = zip(_SPZ, head.widths, strict=True)
    parts = {what: head.splats * width for what, width in widths if width}
    return ByteBreakdown(parts, unpacked=True)


def sog(path: Path) -> ByteBreakdown:
    with zipfile.ZipFile(path) as package:
        return _sog_breakdown((m.filename, m.compress_size) for m in package.infolist())


def streamed_sog(path: Path) -> ByteBreakdown:
    chunks = format_of(path).files(path)[1:]
    return _sog_breakdown((file.name, file.stat().st_size) for file in chunks)


def _sog_breakdown(members: Iterable[tuple[str, int]]) -> ByteBreakdown:
    """By attribute, from (name, bytes) of the files of a SOG."""
    parts: Counter[str] = Counter()
    for name, size in members:
        stem = name.rpartition("/")[2].partition(".")[0].partition("_")[0]
        parts[_SOG.get(stem, stem)] += size
    parts.pop("meta", None)
    return ByteBreakdown(dict(parts))
