"""How many bytes of a file are spent on what."""

from __future__ import annotations

import json
import struct
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.base.bad_files import reading
from stages.formats import format_of, spz_read
from stages.formats.inflate import Inflated
from stages.formats.ply_header import read_header
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
_SPLAT = {"mean": "positions", "scale": "scales", "rgba": "colours, opacities"}
_GLTF = {"POSITION": "positions", "COLOR_0": "fallback colours"}
_GLTF_ENDS = {"ROTATION": "rotations", "SCALE": "scales", "OPACITY": "opacities"}
_GLTF_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5126: 4}
_GLTF_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SPZ = ("positions", "opacities", "colours", "scales", "rotations", "SH")
_SOG = {"means": "positions", "quats": "rotations", "sh0": "colours, opacities", "shN": "SH"}


@dataclass(frozen=True)
class Anatomy:
    """parts: bytes by attribute, "other" for the rest of the file. unpacked: whether the parts are
    counted before the compression that packs them all together."""

    parts: dict[str, int]
    unpacked: bool = False


def anatomy_of(path: Path) -> Anatomy | None:
    """Where the bytes of a file of splats are; None for formats whose parts cannot be told from
    outside (USD, .html). Raises SplatError "splats-unreadable"."""
    path = Path(path)
    name = format_of(path)
    with reading(path):
        if name in ("ply", "compressed.ply"):
            parts = _ply(path)
        elif name == "splat":
            count = path.stat().st_size // RECORD.itemsize
            fields: Any = RECORD.fields or {}
            parts = {_SPLAT.get(k, "rotations"): count * v[0].itemsize for k, v in fields.items()}
        elif name in ("glb", "gltf"):
            parts = _gltf(path)
        elif name == "spz":
            parts, unpacked = _spz(path)
            if unpacked:
                return Anatomy(parts, True)
        elif name == "sog":
            parts = _sog(path)
        else:
            return None
        other = _size(path, name) - sum(parts.values())
        return Anatomy({**parts, "other": other} if other > 0 else parts)


def _size(path: Path, name: str) -> int:
    size = path.stat().st_size
    binary = path.with_suffix(".bin")
    return size + binary.stat().st_size if name == "gltf" and binary.is_file() else size


def _ply(path: Path) -> dict[str, int]:
    with path.open("rb") as file:
        header = read_header(file)
    parts: Counter[str] = Counter()
    for element in header.elements if header.encoding != "ascii" else ():
        for name, kind in element.properties:
            start = next((what for s, what in _PLY_STARTS.items() if name.startswith(s)), "")
            what = _PLY.get(name) or start or "other properties"
            what = "ranges" if element.name == "chunk" else what
            parts[what] += element.count * int(kind[1])
    return dict(parts)


def _gltf(path: Path) -> dict[str, int]:
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
    return dict(parts)


def _spz(path: Path) -> tuple[dict[str, int], bool]:
    """(the parts, whether they are counted unpacked)."""
    sizes = spz_read.packed_sizes(path)
    if sizes:
        return dict(zip(_SPZ, sizes, strict=False)), False
    with path.open("rb") as file:
        head = Inflated(file, path.stat().st_size).read(spz_read.HEADER.size)
    _, version, count, degree, bits, _, _ = spz_read.HEADER.unpack(head)
    widths = spz_read.widths(version, degree, bits)
    return {what: count * width for what, width in zip(_SPZ, widths, strict=True) if width}, True


def _sog(path: Path) -> dict[str, int]:
    parts: Counter[str] = Counter()
    with zipfile.ZipFile(path) as package:
        for member in package.infolist():
            stem = member.filename.rpartition("/")[2].partition(".")[0].partition("_")[0]
            parts[_SOG.get(stem, stem)] += member.compress_size
    parts.pop("meta", None)
    return dict(parts)
