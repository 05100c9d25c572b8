"""The .ply of the reference trainer, which every splat tool reads.

Rows of float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (channel-major: all of red, then
green, then blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3 (w, x, y, z).
The format has no field for axes and units; our files hold them in comments. World: y down.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import BadFileError
from stages.base.row_slices import release_mapped_pages, row_slices
from stages.formats import compressed_ply
from stages.formats.ply_header import Header, binary_rows, header_text, read_header
from stages.formats.values import allocate
from stages.scene import Splats
from stages.scene.recentring import recentred

_ROWS_AT_ONCE = 1 << 14  # 4 MB of degree 3, so that the columns of a block fit the cache
_Tables = Iterator[tuple[slice, NDArray[Any]]]
_NORMAL = ("nx", "ny", "nz")  # not required of a file


def property_names(degree: int) -> list[str]:
    """The columns, in the order of the reference layout, at one SH degree for all."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", *_NORMAL, "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats`.

    Positions stay relative to `splats.origin`, which a comment holds.
    Raises SplatError when the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        for block in file_blocks(splats, units):
            file.write(block)


def file_blocks(splats: Splats, units: str) -> Iterator[bytes]:
    """The bytes of the file in blocks; every splat must be drawable."""
    yield _header_text(splats, units)
    for rows in row_slices(len(splats), _ROWS_AT_ONCE):
        yield _table(splats, rows).tobytes()


def _header_text(splats: Splats, units: str) -> bytes:
    properties = [f"property float {name}" for name in property_names(splats.sh_degree)]
    elements = [f"element vertex {len(splats)}", *properties]
    return header_text(
        *(units, splats.origin, splats.place, elements),
        antialias=splats.draw_settings.antialias,
    )


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

    Properties may be in any order and of any numeric type, with others between them; ascii or
    either byte order; SH degree 0 to 3; compressed files, too (see `compressed_ply`). Raises
    BadFileError for a damaged file or one without splats.
    """
    with path.open("rb") as file:
        header = read_header(file)
        if header.is_compressed:
            return compressed_ply.unpack(path, header)
        _check_is_splats(header)
        names = [name for name, _ in header.vertex.properties]
        count = sum(1 for name in names if name.startswith("f_rest_"))
        if count not in (0, 9, 24, 45):
            raise BadFileError(f"it has {count} f_rest properties, not 0, 9, 24 or 45")
        blocks_of_rows = tables(file, path, header)
        splats = allocate(header.vertex.count, math.isqrt(count // 3 + 1) - 1)
        splats = splats.with_antialias(header.antialias)
        wide = any(name in "xyz" and kind[1] == "8" for name, kind in header.vertex.properties)
        exact = np.empty((len(splats), 3)) if wide or header.encoding == "ascii" else None
        for rows, table in blocks_of_rows:
            _fill(splats.take(rows), table, count)
            if exact is not None:
                exact[rows] = columns(table, ["x", "y", "z"])
            else:
                splats.means[rows] = _floats(table, ["x", "y", "z"])
    if exact is None:
        return replace(splats, origin=header.origin, place=header.place)
    means, origin = recentred(exact, header.origin)
    return replace(splats, means=means, origin=origin, place=header.place)


def _fill(splats: Splats, table: NDArray[Any], rest_count: int) -> None:
    """Fill all but the means of `splats`, which are views of some rows."""
    splats.quaternions[:] = _floats(table, [f"rot_{i}" for i in range(4)])
    splats.log_scales[:] = _floats(table, [f"scale_{i}" for i in range(3)])
    splats.opacity_logits[:] = _floats(table, ["opacity"])[:, 0]
    splats.sh[:, 0] = _floats(table, ["f_dc_0", "f_dc_1", "f_dc_2"])
    rest = _floats(table, [f"f_rest_{i}" for i in range(rest_count)])
    splats.sh[:, 1:] = rest.reshape(len(rest), 3, rest_count // 3).transpose(0, 2, 1)


def _check_is_splats(header: Header) -> None:
    names = {*_NORMAL, *(name for name, _ in header.vertex.properties)}
    missing = [name for name in property_names(0) if name not in names]
    if missing and any(element.name == "face" for element in header.elements):
        raise BadFileError("it is a mesh of triangles, not splats")
    if missing:
        raise BadFileError(f"its vertices lack {', '.join(missing)}: they are no splats")


def tables(file: BinaryIO, path: Path, header: Header) -> _Tables:
    """The vertices of a .ply in blocks: (rows, structured table [M]), for `columns`. Raises
    BadFileError if the file cannot hold what it declares, or if its vertices hold lists."""
    if header.vertex.has_lists:
        raise BadFileError("its vertices hold lists")
    if header.encoding == "ascii":
        ahead = header.before("vertex")
        skipped = sum(element.count * len(element.properties) for element in ahead)
        declared = header.vertex.count * len(header.vertex.properties)
        # A number and its separator take at least two characters.
        if 2 * (skipped + declared) > path.stat().st_size - header.data_starts + 1:
            raise BadFileError("it is cut short: it cannot hold the numbers that it declares")
        return _ascii_tables(file, header, skipped)
    return _binary_tables(binary_rows(path, header, "vertex"))


def _binary_tables(mapped: NDArray[Any]) -> _Tables:
    """The rows of a binary file in blocks."""
    for rows in row_slices(len(mapped), _ROWS_AT_ONCE):
        block = np.array(mapped[rows])
        release_mapped_pages(mapped)
        yield rows, block


def _ascii_tables(file: BinaryIO, header: Header, skipped: int) -> _Tables:
    """The rows of a text file in blocks, all columns float64. skipped: how many numbers are before
    the vertices. Raises BadFileError and ValueError."""
    names = [name for name, _ in header.vertex.properties]
    file.seek(header.data_starts)
    np.fromfile(file, count=skipped, sep=" ")
    for rows in row_slices(header.vertex.count, _ROWS_AT_ONCE):
        wanted = (rows.stop - rows.start) * len(names)
        numbers = np.fromfile(file, count=wanted, sep=" ")
        if len(numbers) < wanted:
            raise BadFileError("it is cut short: it holds fewer numbers than it declares")
        yield rows, numbers.view([(name, "f8") for name in names])


def columns(table: NDArray[Any], names: list[str]) -> NDArray[Any]:
    """[M, len(names)] of a structured table [M], in the common type of the columns."""
    if not names:
        return np.empty((len(table), 0), np.float32)
    return structured_to_unstructured(table[names])


def _floats(table: NDArray[Any], names: list[str]) -> NDArray[np.float32]:
    """`columns` as float32. Raises BadFileError for values that float32 cannot hold."""
    exact = columns(table, names)
    with np.errstate(over="ignore"):
        out = exact.astype(np.float32)
    if exact.dtype.itemsize == 8 and (lost := np.isinf(out) & np.isfinite(exact)).any():
        name = names[int(lost.any(axis=0).argmax())]
        raise BadFileError(f"values of {name} are too large")
    return out
