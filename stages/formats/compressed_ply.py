"""The compressed .ply of the PlayCanvas tools (.compressed.ply): 16 bytes a splat, and 3 more for
each SH coefficient above degree 0.

Rows come in chunks of 256 neighbours, outliers at the end (see `order`). An element `chunk` holds
the least and greatest position, scale logarithm and colour (0.5 + C0 dc) of each; `vertex` holds
four uint a splat: packed_position and packed_scale, 11 + 10 + 11 bits of x, y, z within the chunk's
range, x highest; packed_rotation, 2 bits for the index of the largest of w, x, y, z and 10 bits for
each other; packed_color, 8 bits each of red, green, blue (within the chunk's range) and opacity.
`sh` holds f_rest_0.. as uchar, channel-major as in the .ply. Axes as in memory (y down).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import BadFileError
from stages.base.row_slices import row_slices
from stages.formats import smallest_three
from stages.formats.ply_header import Header, binary_rows, header_text, read_header
from stages.formats.values import (
    allocate,
    linear_opacities,
    logits_of,
    unit_quaternions,
)
from stages.scene import SH_C0, Splats, morton
from stages.scene.quantiles import quantiles

CHUNK = 256
# The logarithm -87 of a flat splat would take the precision of its whole chunk. Scales below
# exp(-20) or above exp(20) units look the same at the limit.
LOG_SCALE_LIMIT = 20.0
# One extreme colour would take the 8 bits of its whole chunk. 1 is white; the colours of trained
# scenes lie within -0.5..2.5.
COLOUR_LIMIT = 4.0
# Splats farther from the median centre than this many extents of the scene are outliers. They are
# sorted into shells, each this many times as wide as the one before.
_OUTLIER_EXTENTS, _SHELL_RATIO = 4.0, 4.0
SH_LIMIT = 4.0  # uchar 0..255 stand for -SH_LIMIT..SH_LIMIT
_BLOCK = CHUNK * 256
_AXES_BITS = (11, 10, 11)
_COLOUR_BITS = (8, 8, 8, 8)
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = (
    ("{}_x", "{}_y", "{}_z"),
    ("{}_scale_x", "{}_scale_y", "{}_scale_z"),
    ("{}_r", "{}_g", "{}_b"),
)


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats`.

    Positions stay relative to `splats.origin`, which a comment holds. All splats get one SH
    degree, and coefficients and colours are clipped to -4..4. Raises SplatError when the file
    cannot be written.
    """
    degree = int(splats.sh_degrees.max(initial=0))
    splats, rows = splats.with_sh_degree(degree), order(splats)
    packed = [_pack(splats.take(rows[part])) for part in row_slices(len(splats), _BLOCK)]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header_text(splats, degree, units))
        for part in range(3):  # all chunks, then all vertices, then all SH
            for block in packed:
                file.write(block[part].data)


def order(splats: Splats) -> NDArray[np.intp]:
    """[N] rows of `splats` as a file holds them: in Morton order, and after these the outliers, by
    shells of distance.

    The precision of a chunk is that of its range, so one outlier would ruin the positions of 255
    neighbours. Chunks cannot be left incomplete: the one in which the outliers begin is filled with
    the splats that are least visible.
    """
    rows, shells = morton.morton_order(splats), outlier_shells(splats.means)
    if not shells.any():
        return rows
    inliers = np.flatnonzero(shells == 0)
    shells += shells > 0
    if filling := len(inliers) % CHUNK:
        shells[
            inliers[np.argpartition(_visibility(splats.take(inliers)), filling - 1)[:filling]]
        ] = 1
    return rows[np.argsort(shells[rows], kind="stable")]


def outlier_shells(means: NDArray[np.floating]) -> NDArray[np.int64]:
    """[N] 0 for splats of the scene; 1, 2, ... for outliers by their distance."""
    low, centre, high = quantiles(means, (0.05, 0.5, 0.95))
    limit = _OUTLIER_EXTENTS * float(np.linalg.norm(high - low))
    shells = np.zeros(len(means), np.int64)
    if limit > 0:
        for part in row_slices(len(means)):
            far = np.linalg.norm(means[part] - centre, axis=1) / limit
            shells[part] = np.ceil(np.log(np.maximum(far, 1)) / np.log(_SHELL_RATIO))
    return shells


def _visibility(splats: Splats) -> NDArray[np.float64]:
    """[N] logarithm of opacity times the area of the largest side."""
    area = np.sort(splats.log_scales, axis=1)[:, 1:].sum(axis=1, dtype=np.float64)
    return np.asarray(area - np.logaddexp(0, -splats.opacity_logits))


def _header_text(splats: Splats, degree: int, units: str) -> bytes:
    lines = [f"element chunk {-(-len(splats) // CHUNK)}"]
    for names in _RANGES:
        lines += [f"property float {name.format(end)}" for end in ("min", "max") for name in names]
    lines.append(f"element vertex {len(splats)}")
    lines += [f"property uint {name}" for name in _WORDS]
    if degree:
        lines.append(f"element sh {len(splats)}")
        rest = 3 * ((degree + 1) ** 2 - 1)
        lines += [f"property uchar f_rest_{i}" for i in range(rest)]
    return header_text(
        *(units, splats.origin, splats.place, lines),
        antialias=splats.draw_settings.antialias,
    )


def _pack(splats: Splats) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(ranges [chunks, 18] float32, words [N, 4] uint32, SH [N, 3K] uint8) of whole chunks."""
    colours = 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)
    colours = np.clip(colours, -COLOUR_LIMIT, COLOUR_LIMIT)
    scales = np.clip(splats.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    positions, ranges = _within_chunks(splats.means)
    scale_fractions, scale_ranges = _within_chunks(scales)
    colour, colour_ranges = _within_chunks(colours)
    rgba = np.concatenate([colour, linear_opacities(splats)[:, None]], axis=1)
    largest, others = smallest_three.split(unit_quaternions(splats.quaternions))
    rotations = _pack_bits(smallest_three.fractions_of(others), (10, 10, 10))
    words = (
        _pack_bits(positions, _AXES_BITS),
        rotations | largest.astype(np.uint32) << np.uint32(30),
        _pack_bits(scale_fractions, _AXES_BITS),
        _pack_bits(rgba, _COLOUR_BITS),
    )
    sh = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1).astype(np.float64)
    steps = np.floor((sh / (2 * SH_LIMIT) + 0.5) * 256)
    return (
        np.concatenate([ranges, scale_ranges, colour_ranges], axis=1).astype("<f4"),
        np.stack(words, axis=1).astype("<u4"),
        np.clip(steps, 0, 255).astype(np.uint8),
    )


def _within_chunks(
    values: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(`values` [N, 3] as fractions of their chunk's range; least and greatest [chunks, 6])."""
    starts = np.arange(0, len(values), CHUNK)
    low = np.minimum.reduceat(values, starts).astype(np.float32)
    high = np.maximum.reduceat(values, starts).astype(np.float32)
    least = np.repeat(low.astype(np.float64), CHUNK, axis=0)[: len(values)]
    span = np.repeat(high.astype(np.float64), CHUNK, axis=0)[: len(values)] - least
    fractions = (values - least) / np.where(span > 0, span, 1.0)
    return fractions, np.concatenate([low, high], axis=1)


def _pack_bits(fractions: NDArray[np.floating], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """[N] the columns of `fractions` (0..1) packed into one word, the first column highest."""
    word = np.zeros(len(fractions), np.uint32)
    for column, width in zip(fractions.T, bits, strict=True):
        top = (1 << width) - 1
        steps = np.clip(np.rint(column * top), 0, top).astype(np.uint32)
        word = word << np.uint32(width) | steps
    return word


def _unpack_bits(word: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """[N, len(bits)] the inverse of `_pack_bits`."""
    columns = []
    shift = sum(bits)
    for width in bits:
        shift -= width
        top = (1 << width) - 1
        columns.append((word >> np.uint32(shift) & np.uint32(top)) / top)
    return np.stack(columns, axis=1)


def read(path: Path) -> Splats:
    """The splats of a compressed .ply, float32; SH and colour ranges are optional.

    Raises BadFileError for a damaged file or another kind of .ply.
    """
    with path.open("rb") as file:
        header = read_header(file)
    if not header.is_compressed:
        raise BadFileError("it is no compressed .ply: its name should end in .ply alone")
    return unpack(path, header)


def unpack(path: Path, header: Header) -> Splats:
    """The splats of a compressed .ply whose header was read. Raises BadFileError."""
    if header.encoding == "ascii":
        raise BadFileError("it is a compressed .ply as text, which is not supported")
    _require(header, "vertex", _WORDS)
    _require(
        header, "chunk", [name.format(e) for n in _RANGES[:2] for name in n for e in ("min", "max")]
    )
    vertices: NDArray[Any] = binary_rows(path, header, "vertex")
    ranges: NDArray[Any] = binary_rows(path, header, "chunk")[: -(-len(vertices) // CHUNK)]
    if len(ranges) * CHUNK < len(vertices):
        raise BadFileError(f"it has {len(ranges)} chunks for {len(vertices)} splats")
    if any(vertices.dtype[name].str[1:] != "u4" for name in _WORDS):
        raise BadFileError("it is a compressed .ply whose words are no uint")
    rest = _sh_rows(path, header)
    degree = 0 if rest is None else math.isqrt(len(rest.dtype.names or ()) // 3 + 1) - 1
    splats = allocate(len(vertices), degree)
    splats = replace(splats, origin=header.origin, place=header.place)
    splats = splats.with_antialias(header.antialias)
    for rows in row_slices(len(vertices), _BLOCK):
        chunks = ranges[rows.start // CHUNK : -(-rows.stop // CHUNK)]
        _unpack_block(splats.take(rows), vertices[rows], chunks)
        if degree and rest is not None:
            splats.sh[rows, 1:] = _sh_values(rest[rows])
    return splats


def _unpack_block(out: Splats, vertices: NDArray[Any], ranges: NDArray[Any]) -> None:
    """Fill `out` (all but the SH above degree 0) with the splats of whole chunks."""
    words = [vertices[name].astype(np.uint32) for name in _WORDS]
    rgba = _unpack_bits(words[3], _COLOUR_BITS)
    colours = _in_range(rgba[:, :3], ranges, _RANGES[2])
    largest_float = float(np.finfo(np.float32).max)
    rotations = smallest_three.from_fractions(_unpack_bits(words[1], (2, 10, 10, 10))[:, 1:])
    out.means[:] = _in_range(_unpack_bits(words[0], _AXES_BITS), ranges, _RANGES[0])
    out.quaternions[:] = smallest_three.join(words[1] >> np.uint32(30), rotations)
    out.log_scales[:] = _in_range(_unpack_bits(words[2], _AXES_BITS), ranges, _RANGES[1])
    out.opacity_logits[:] = logits_of(rgba[:, 3])
    out.sh[:, 0] = np.clip((colours - 0.5) / SH_C0, -largest_float, largest_float)


def _require(header: Header, element: str, names: Any) -> None:
    there = {name for name, _ in header.element(element).properties}
    missing = [name for name in names if name not in there]
    if missing:
        raise BadFileError(f"it is a compressed .ply whose {element} lacks {', '.join(missing)}")


def _in_range(
    fractions: NDArray[np.float64], ranges: NDArray[Any], names: tuple[str, ...]
) -> NDArray[np.float64]:
    """[N, 3] the inverse of `_within_chunks`. Older files lack colour ranges: these are 0..1."""
    values = np.empty_like(fractions)
    for i, name in enumerate(names):
        ends = []
        for end, default in (("min", 0.0), ("max", 1.0)):
            key = name.format(end)
            known = key in (ranges.dtype.names or ())
            column = ranges[key].astype(np.float64) if known else np.full(len(ranges), default)
            if not (np.abs(column) <= np.finfo(np.float32).max).all():
                raise BadFileError(f"values of {key} are not finite numbers")
            ends.append(np.repeat(column, CHUNK)[: len(fractions)])
        values[:, i] = ends[0] + (ends[1] - ends[0]) * fractions[:, i]
    return values


def _sh_rows(path: Path, header: Header) -> NDArray[Any] | None:
    """[N] rows of f_rest_0..; None without SH above degree 0."""
    if not any(element.name == "sh" for element in header.elements):
        return None
    kept = header.element("sh")
    names = [name for name, _ in kept.properties if name.startswith("f_rest_")]
    if len(names) not in (0, 9, 24, 45) or any(kind != "u1" for _, kind in kept.properties):
        raise BadFileError(f"its element sh has {len(names)} f_rest, not 0, 9, 24 or 45 of uchar")
    names = [f"f_rest_{i}" for i in range(len(names))]
    _require(header, "sh", names)
    if kept.count != header.vertex.count:
        raise BadFileError(f"it has {kept.count} rows of SH for {header.vertex.count} splats")
    rows: NDArray[Any] = binary_rows(path, header, "sh")
    return rows[names] if names else None


def _sh_values(rows: NDArray[Any]) -> NDArray[np.float32]:
    """[M, K, 3] coefficients above degree 0."""
    levels = (np.arange(256) + 0.5) / 256
    levels[[0, 255]] = (0.0, 1.0)
    values = ((levels - 0.5) * 2 * SH_LIMIT).astype(np.float32)
    steps = np.stack([rows[name] for name in rows.dtype.names or ()], axis=1)
    return np.asarray(values[steps].reshape(len(rows), 3, -1).transpose(0, 2, 1))
