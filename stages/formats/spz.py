"""SPZ: about an eighth of a .ply, for the web. Written as version 3 or 4.

Version 3, which most viewers read: gzip around a header of 16 bytes (magic "NGSP", version, count,
SH degree, fractional bits of positions, flags, 0) and one array after the other: positions 3 x
24-bit fixed point, opacities uint8 (255 sigmoid, kept within 1..254), colours 3 x uint8 (0.15 dc +
0.5), scales 3 x uint8 (16 (ln + 10)), rotations (smallest three of x, y, z, w in 32 bits), SH uint8
(128 + 128 c), coefficients of one splat together, RGB last. Axes: right, up, back (y up). Version
4: the same arrays, each in a zstd frame; see `spz_read`. Specification: nianticlabs/spz, README.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.row_slices import row_slices
from stages.formats import smallest_three
from stages.formats.spz_read import (
    ANTIALIASED,
    COLOUR_SCALE,
    HEADER,
    MAGIC,
    MAGNITUDE,
    TABLE_ROW,
    TABLE_STARTS,
    Header,
)
from stages.formats.values import linear_opacities, unit_quaternions
from stages.scene import Splats
from stages.scene.flip import FLIP, flipped
from stages.scene.quantiles import median_spacing

_LEVEL = 6  # 9 takes eight times as long for 1 % less
_ZSTD_LEVEL = 12  # that of the format's own library
_USUAL_FRACTIONAL_BITS, _MOST_FRACTIONAL_BITS = 12, 23
# Where 12 fractional bits do not hold the scene, fewer do: steps up to this share of the distance
# between neighbouring splats.
_STEP_OF_SPACING = 1 / 16
_OUTLIERS = 0.01  # at most this share of the splats is moved for finer steps
_FIXED_LIMIT = (1 << 23) - 1
LOG_SIZES = (-10.0, -10.0 + 255 / 16)
_SH_STEPS = (8, 16, 16)  # of 256, for degree 1, 2, 3: 5 and 4 bits, which gzip compresses


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats` as version 3.

    The format has no field for units and the origin; `formats.write` writes them beside it. A splat
    beyond the range of 24 bits is moved closer along its ray and scaled
    down, which looks the same from the centre. Raises SplatError when the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        pack(file, splats)


def pack(file: BinaryIO, splats: Splats) -> None:
    """Write `splats` to an open file as `write` does."""
    head, arrays = _encoded(splats)
    # without a name and a time, so that equal splats give equal bytes
    with gzip.GzipFile("", "wb", _LEVEL, file, mtime=0) as packed:
        packed.write(HEADER.pack(*head))
        for array in arrays:
            packed.writelines(array)


def write_4(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats` as `write` does, but as version 4."""
    head, arrays = _encoded(splats)
    sizes = [head.splats * width for width in head.widths if width]
    head = head._replace(version=4, streams=len(sizes))
    table_starts = HEADER.size + TABLE_STARTS.size
    table = b""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(HEADER.pack(*head) + TABLE_STARTS.pack(table_starts))
        file.seek(table_starts + len(sizes) * TABLE_ROW.size)
        for size, array in zip(sizes, arrays, strict=False):
            start, packer = file.tell(), zstandard.ZstdCompressor(_ZSTD_LEVEL)
            with packer.stream_writer(file, size, closefd=False) as packed:
                for block in array:
                    packed.write(block)
            table += TABLE_ROW.pack(file.tell() - start, size)
        file.seek(table_starts)
        file.write(table)


def _encoded(splats: Splats) -> tuple[Header, list[Iterator[memoryview]]]:
    """The header of version 3, and the blocks of each array."""
    degree = int(splats.sh_degrees.max(initial=0))
    splats = splats.with_sh_degree(degree)
    bits, flags = _fractional_bits(splats.means), ANTIALIASED * splats.draw_settings.antialias
    arrays: tuple[Callable[[Splats], NDArray[Any]], ...] = (
        lambda block: _positions(block, bits),
        _opacities,
        lambda block: _byte(255 * (COLOUR_SCALE * block.sh[:, 0].astype(np.float64) + 0.5)),
        lambda block: _byte(16 * (_within_reach(block, bits).log_scales - LOG_SIZES[0])),
        lambda block: _pack_rotations(flipped(block.with_sh_degree(0)).quaternions),
        _sh,
    )
    return Header(MAGIC, 3, len(splats), degree, bits, flags, 0), [
        _blocks(array, splats) for array in arrays
    ]


def _blocks(array: Callable[[Splats], NDArray[Any]], splats: Splats) -> Iterator[memoryview]:
    for rows in row_slices(len(splats)):
        yield np.ascontiguousarray(array(splats.take(rows))).data


def _reach(bits: int) -> float:
    """The largest coordinate that 24 bits hold."""
    return _FIXED_LIMIT / (1 << bits)


def _within_reach(splats: Splats, bits: int) -> Splats:
    """Splats beyond the range of 24 bits are scaled towards the centre; means and log_scales are
    float64."""
    reach = _reach(bits)
    means = splats.means.astype(np.float64)
    factors = reach / np.maximum(np.abs(means).max(axis=1, initial=0.0), reach)
    return replace(
        splats,
        means=means * factors[:, None],
        log_scales=splats.log_scales.astype(np.float64) + np.log(factors)[:, None],
    )


def _fractional_bits(means: NDArray[np.floating]) -> int:
    """As many as the largest coordinate allows: small scenes get finer steps. Scenes beyond 2048
    units get coarser steps, as long as neighbouring splats stay distinct: a few outliers are moved
    rather."""
    farthest = np.abs(means).max(axis=1, initial=0.0)
    most = _bits_that_hold(float(farthest.max(initial=0.0)))
    if most >= _USUAL_FRACTIONAL_BITS:
        return min(most, _MOST_FRACTIONAL_BITS)
    spacing = median_spacing(means)
    distinct = max(math.ceil(-math.log2(_STEP_OF_SPACING * spacing)), 0) if spacing else 0
    most_splats = _bits_that_hold(float(np.quantile(farthest, 1 - _OUTLIERS, method="lower")))
    return max(most, min(distinct, most_splats, _USUAL_FRACTIONAL_BITS), 0)


def _bits_that_hold(coordinate: float) -> int:
    """The most fractional bits with which 24 bits hold `coordinate`."""
    if coordinate == 0:
        return _USUAL_FRACTIONAL_BITS
    return math.floor(math.log2(_FIXED_LIMIT / coordinate))


def _positions(splats: Splats, bits: int) -> NDArray[np.uint8]:
    """[N, 3, 3] three bytes a coordinate, y up."""
    y_up = _within_reach(splats, bits).means * FLIP
    fixed = np.rint(y_up * float(1 << bits)).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _sh(splats: Splats) -> NDArray[np.uint8]:
    """[N, K, 3] SH above degree 0, y up."""
    sh = flipped(splats).sh[:, 1:]
    steps = np.array([_SH_STEPS[math.isqrt(k) - 1] for k in range(1, 1 + sh.shape[1])], np.float64)
    levels = np.rint(128 * sh.astype(np.float64)) + 128
    levels = np.floor((levels / steps[:, None]) + 0.5) * steps[:, None]
    return _byte(levels)


def _opacities(splats: Splats) -> NDArray[np.uint8]:
    """[N] in 1..254: some readers take the logit of 0 and 255, which is infinite, and the
    difference is not visible."""
    return np.clip(_byte(255 * linear_opacities(splats)), 1, 254)


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(values), 0, 255).astype(np.uint8))


def _pack_rotations(quaternions: NDArray[np.floating]) -> NDArray[np.uint32]:
    """[N] 2 bits for the index of the largest of x, y, z, w; sign and 9 bits for each other."""
    xyzw = unit_quaternions(quaternions)[:, [1, 2, 3, 0]]
    largest, others = smallest_three.split(xyzw)
    word = largest.astype(np.uint32)
    for column in others.T:
        magnitude = np.rint(np.abs(column) / smallest_three.LIMIT * MAGNITUDE).astype(np.uint32)
        sign = (column < 0).astype(np.uint32)
        word = word << np.uint32(10) | sign << np.uint32(9) | magnitude
    return word.astype("<u4")
