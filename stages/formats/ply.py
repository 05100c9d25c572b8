"""The .ply of the reference trainer, which every splat tool reads.

Rows of float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (channel-major: all of red, then
green, then blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3 (w, x, y, z).
The format records neither axes nor units; ours says them in comments. World: y down, as in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from stages.formats import compressed_ply
from stages.formats.ply_header import Header, binary_rows, read_header
from stages.formats.problems import BadFileError, reading
from stages.formats.rows import checked, kept_rows
from stages.run.atomic import replacing
from stages.scene import Splats

_ROWS_AT_ONCE = 1 << 16
_REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def property_names(degree: int) -> list[str]:
    """The columns, in the order of the reference layout, at one SH degree for all."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> int:
    """Write `splats`; return how many could not be drawn and were left out.

    Positions stay relative to `splats.origin`, which float32 could not hold; a comment says it.
    Raises SplatError when the file cannot be written.
    """
    splats, dropped = kept_rows(splats)
    with replacing(path) as temporary, temporary.open("wb") as file:
        for block in blocks(splats, units):
            file.write(block)
    return dropped


def blocks(splats: Splats, units: str) -> Iterator[bytes]:
    """The bytes of the file, a part at a time; every splat must be drawable."""
    yield _header_text(splats, units).encode("ascii")
    for start in range(0, len(splats), _ROWS_AT_ONCE):
        yield _table(splats, slice(start, start + _ROWS_AT_ONCE)).tobytes()


def _header_text(splats: Splats, units: str) -> str:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment up axis: -y (right-handed; x right, y down, z forward)",
        f"comment units: {units}",
    ]
    if splats.origin.any():
        lines.append("comment splat_origin " + " ".join(repr(float(v)) for v in splats.origin))
    lines.append(f"element vertex {len(splats)}")
    lines += [f"property float {name}" for name in property_names(splats.sh_degree)]
    return "\n".join([*lines, "end_header", ""])


def _table(splats: Splats, rows: slice) -> NDArray[np.float32]:
    sh = splats.sh[rows]
    columns = (
        splats.means[rows],
        np.zeros_like(splats.means[rows]),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1),
        splats.opacity_logits[rows, None],
        splats.log_scales[rows],
        splats.quaternions[rows],
    )
    return np.concatenate(columns, axis=1).astype("<f4")


def read(path: Path) -> Splats:
    """The splats of a .ply, float32.

    Any order of properties, extra ones, ascii or either byte order, any numeric type, normals or
    not, degree 0 to 3; packed ones too (see `compressed_ply`). Raises SplatError
    "splats-unreadable" for what is damaged or is not splats.
    """
    path = Path(path)
    with reading(path):
        return parse(path)


def parse(path: Path) -> Splats:
    """As `read`, but what is wrong is raised as it is found."""
    with path.open("rb") as file:
        header = read_header(file)
        if header.is_compressed:
            return compressed_ply.unpack(path, header)
        _check_is_splats(header)
        columns = _Columns(_read_rows(path, file, header), header.ascii_names)
        count = sum(1 for name in columns.names if name.startswith("f_rest_"))
        if count not in (0, 9, 24, 45):
            raise BadFileError(f"it has {count} f_rest properties, not 0, 9, 24 or 45")
        rest = columns.floats([f"f_rest_{i}" for i in range(count)])
        dc = columns.floats(["f_dc_0", "f_dc_1", "f_dc_2"])
        rest = rest.reshape(len(rest), 3, count // 3).transpose(0, 2, 1)
        return checked(
            Splats(
                means=columns.floats(["x", "y", "z"]),
                quaternions=columns.floats([f"rot_{i}" for i in range(4)]),
                log_scales=columns.floats([f"scale_{i}" for i in range(3)]),
                opacity_logits=columns.floats(["opacity"])[:, 0],
                sh=np.concatenate([dc[:, None], rest], axis=1),
                sh_degrees=np.zeros(len(dc), np.uint8),
                origin=header.origin,
            )
        )


def _check_is_splats(header: Header) -> None:
    names = {name for name, _ in header.vertex.properties}
    missing = [name for name in _REQUIRED if name not in names]
    if missing and any(element.name == "face" for element in header.elements):
        raise BadFileError("it is a mesh of triangles, not splats")
    if missing:
        raise BadFileError(f"its vertices lack {', '.join(missing)}: they are no splats")
    if header.vertex.has_lists:
        raise BadFileError("its vertices hold lists")


def _read_rows(path: Path, file: BinaryIO, header: Header) -> NDArray[np.generic]:
    """[N] structured rows mapped from the file, or for ascii an [N, P] float64 table."""
    if header.encoding == "ascii":
        return _read_ascii_rows(path, file, header)
    return binary_rows(path, header, "vertex")


def _read_ascii_rows(path: Path, file: BinaryIO, header: Header) -> NDArray[np.generic]:
    skipped = sum(element.count * len(element.properties) for element in header.before("vertex"))
    width = len(header.vertex.properties)
    wanted = header.vertex.count * width
    # A number and its separator take two characters at least.
    if 2 * (skipped + wanted) > path.stat().st_size - header.data_starts + 1:
        raise BadFileError("it is cut short: it cannot hold the numbers that it declares")
    file.seek(header.data_starts)
    words = _words(file)
    table = np.empty(wanted)
    filled = -skipped
    for numbers in words:
        chunk = np.array(numbers, dtype=np.float64)
        first = max(0, -filled)
        room = chunk[first : first + max(0, wanted - max(filled, 0))]
        table[max(filled, 0) : max(filled, 0) + len(room)] = room
        filled += len(chunk)
        if filled >= wanted:
            return table.reshape(header.vertex.count, width)
    if wanted and filled < wanted:
        raise BadFileError(f"it is cut short: {wanted} numbers declared, {max(filled, 0)} there")
    return table.reshape(header.vertex.count, width)


def _words(file: BinaryIO) -> Iterator[list[bytes]]:
    """The file's words, some ten thousand at a time."""
    rest = b""
    while block := file.read(1 << 18):
        block = rest + block
        cut = max(block.rfind(b" "), block.rfind(b"\n"), block.rfind(b"\r"), block.rfind(b"\t")) + 1
        if cut == 0 and len(block) > 1 << 18:
            raise BadFileError("it holds a word that is no number")
        rest = block[cut:]
        yield block[:cut].split()
    yield rest.split()


@dataclass(frozen=True)
class _Columns:
    rows: NDArray[np.generic]
    ascii_names: list[str] | None

    @property
    def names(self) -> list[str]:
        return list(
            self.ascii_names if self.ascii_names is not None else self.rows.dtype.names or ()
        )

    def floats(self, names: list[str]) -> NDArray[np.float32]:
        """[N, len(names)] float32. Raises BadFileError for values that float32 cannot hold."""
        out = np.empty((len(self.rows), len(names)), np.float32)
        for i, name in enumerate(names):
            if name not in self.names:
                raise BadFileError(f"its vertices lack {name}")
            column = self._column(name)
            with np.errstate(over="ignore"):
                out[:, i] = column
            if column.dtype.itemsize == 8 and (np.isinf(out[:, i]) & np.isfinite(column)).any():
                raise BadFileError(f"values of {name} are too large")
        return out

    def _column(self, name: str) -> NDArray[Any]:
        rows: NDArray[Any] = self.rows
        return rows[name] if self.ascii_names is None else rows[:, self.ascii_names.index(name)]
