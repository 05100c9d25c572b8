"""The header of a .ply, and the rows of its elements in binary files."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.formats.json_fields import agreed, place_of
from stages.scene.place import EarthPlace

HEADER_LIMIT_BYTES = 1 << 20
_MOST_PROPERTIES = 1000
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


def header_text(
    units: str,
    origin: NDArray[np.float64],
    place: EarthPlace | None,
    elements: Sequence[str],
    note: str = "",
    antialias: bool = False,
) -> bytes:
    """The header of a binary file that we write.

    Args:
        units: "metres" or "arbitrary".
        origin, place: of the scene, as in `Splats`.
        elements: the lines of elements and properties.
        note: a comment.
        antialias: whether the splats are to be drawn with opacity compensation. Said in the comment
            of Brush (ArthurBrussee/brush, crates/brush-serde), which splat-transform also writes.
    """
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {note}"] if note else [])]
    lines.append("comment up axis: -y (right-handed; x right, y down, z forward)")
    lines.append(f"comment units: {units}")
    if origin.any():
        lines.append("comment splat_origin " + " ".join(repr(float(v)) for v in origin))
    if place is not None:
        lines.append(f"comment splat_place {json.dumps(place.beside(origin).to_json())}")
    if antialias:
        lines.append("comment SplatRenderMode: mip")
    return "\n".join([*lines, *elements, "end_header", ""]).encode("ascii")


@dataclass(frozen=True)
class Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]  # (name, numpy type without byte order)
    has_lists: bool


@dataclass(frozen=True)
class Header:
    """What the header declares.

    Attributes:
        origin, place: as in `Splats`.
        antialias: whether a comment asks for opacity compensation.
        vertical: the axis that a comment calls vertical, such as "z"; "" without one. The values
            are kept as they are: the cameras of these splats are in the same axes.
    """

    encoding: str
    elements: tuple[Element, ...]
    origin: NDArray[np.float64]
    place: EarthPlace | None
    antialias: bool
    vertical: str
    data_starts: int

    @property
    def vertex(self) -> Element:
        return self.element("vertex")

    def element(self, name: str) -> Element:
        """Raises BadFileError if there is none."""
        for element in self.elements:
            if element.name == name:
                return element
        raise BadFileError(f"it has no element {name}")

    @property
    def is_compressed(self) -> bool:
        """Whether its splats are packed into integers, see `compressed_ply`."""
        return any(name == "packed_position" for name, _ in self.vertex.properties)

    def before(self, name: str) -> list[Element]:
        """The elements before `name`. Raises BadFileError if one has rows of unknown length."""
        ahead: list[Element] = []
        for element in self.elements:
            if element.name == name:
                break
            if element.has_lists:
                raise BadFileError("it holds lists ahead of its vertices")
            ahead.append(element)
        return ahead


def read_header(file: BinaryIO) -> Header:
    start = file.read(HEADER_LIMIT_BYTES)
    if not start.startswith(b"ply"):
        raise BadFileError("it does not start with 'ply'")
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", start)
    if end is None:
        raise BadFileError("its header does not end")
    encoding, origin, elements, vertical = "", np.zeros(3), [], ""
    stated = None
    said: list[bool] = []
    for line in re.split(r"[\r\n]+", start[: end.start()].decode("utf-8", "replace"))[1:]:
        words = line.split()
        match words:
            case ["format", encoding, *_]:
                pass
            case ["comment", "splat_origin", x, y, z]:
                origin = np.array([float(x), float(y), float(z)])
            case ["comment", "splat_place", *rest]:
                stated = json.loads(" ".join(rest))
            case ["element", name, count]:
                elements.append(Element(name, _count(count), (), False))
            case ["property", *rest] if elements:
                elements[-1] = _with_property(elements[-1], rest)
            case ["comment", *words]:
                said += _antialias(words)
                vertical = _vertical(words) or vertical
            case [] | ["obj_info", *_]:
                pass
            case _:
                raise BadFileError(f"its header holds a line that is not understood: {line[:80]!r}")
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise BadFileError(f"its encoding {encoding[:40]!r} is not known")
    antialias = agreed(said, "its comments contradict each other about antialiasing")
    place = place_of(stated, origin)
    return Header(encoding, tuple(elements), origin, place, antialias, vertical, end.end())


def _antialias(words: list[str]) -> list[bool]:
    """What a comment says of opacity compensation: [] for nothing. Brush writes "SplatRenderMode:
    mip" or "default", Postshot "antialiased 1" or "0"."""
    match [word.lower() for word in words]:
        case ["splatrendermode:", "mip"] | ["antialiased", "1"]:
            return [True]
        case ["splatrendermode:", "default"] | ["antialiased", "0"]:
            return [False]
    return []


def _vertical(words: list[str]) -> str:
    """The axis that a comment calls vertical: "" for none. nerfstudio writes "Vertical Axis: z" and
    means up, Brush "Vertical axis: y" in worlds of y down."""
    match [word.lower() for word in words]:
        case ["vertical", "axis:", axis] if re.fullmatch("[-+]?[xyz]", axis):
            return axis.removeprefix("+")
    return ""


def _count(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,15}", text):
        raise BadFileError(f"it declares {text[:40]!r} elements")
    return int(text)


def _with_property(element: Element, words: list[str]) -> Element:
    match words:
        case ["list", _, _, name]:
            return Element(element.name, element.count, element.properties, True)
        case [kind, name] if kind in TYPES:
            if len(element.properties) == _MOST_PROPERTIES:
                raise BadFileError(f"it declares more than {_MOST_PROPERTIES} properties")
            if any(name == known for known, _ in element.properties):
                raise BadFileError(f"it declares the property {name[:40]!r} twice")
            properties = (*element.properties, (name, TYPES[kind]))
            return Element(element.name, element.count, properties, element.has_lists)
    raise BadFileError(f"its header holds a property that is not understood: {words[:4]!r}"[:120])


def binary_rows(path: Path, header: Header, name: str) -> NDArray[np.generic]:
    """[N] structured rows of the element `name`, memory-mapped from a binary file. Raises
    BadFileError if the file is shorter than it declares."""
    element = header.element(name)
    if element.has_lists:
        raise BadFileError("its vertices hold lists")
    offset = header.data_starts
    order = "<" if header.encoding == "binary_little_endian" else ">"
    for other in header.before(name):
        offset += other.count * sum(np.dtype(kind).itemsize for _, kind in other.properties)
    row = np.dtype([(name, order + kind) for name, kind in element.properties])
    wanted, there = element.count * row.itemsize, path.stat().st_size - offset
    if there < wanted:
        what = "vertices" if name == "vertex" else f"element {name}"
        raise BadFileError(
            f"it is cut short: {wanted} bytes of {what} declared, {max(0, there)} there"
        )
    if element.count == 0:
        return np.zeros(0, row)
    return np.memmap(path, row, "r", offset, element.count)
