"""SPZ: about an eighth of a .ply, for the web.

Version 3 is written, 2 and 3 are read: gzip around a header of 16 bytes (magic "NGSP", version,
count, SH degree, fractional bits of positions, flags, 0) and one array after the other:
positions 3 x 24-bit fixed point, opacities uint8, colours 3 x uint8 (0.15 dc + 0.5), scales
3 x uint8 (16 (ln + 10)), rotations (version 3: the smallest three of x, y, z, w in 32 bits; version
2: x, y, z as uint8), SH uint8 (128 + 128 c), coefficients of one splat together, RGB last.
Axes: right, up, back, so the splats are turned upright. Specification: nianticlabs/spz, README.
"""

from __future__ import annotations

import gzip
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.formats import smallest_three
from stages.formats.inflate import Inflated
from stages.formats.problems import BadFileError, reading
from stages.formats.rows import checked, kept_rows, linear_opacities, logits_of, unit_quaternions
from stages.formats.turn import turned
from stages.run.atomic import replacing
from stages.scene import Splats

HEADER = struct.Struct("<4sIIBBBB")
_MAGIC = b"NGSP"
_LEAST_FRACTIONAL_BITS, _MOST_FRACTIONAL_BITS = 12, 23
_FIXED_LIMIT = (1 << 23) - 1
_COLOUR_SCALE = 0.15
_SH_STEPS = (8, 16, 16)  # of 256, for degree 1, 2, 3: 5 and 4 bits, which gzip then packs
_MAGNITUDE = 511  # 9 bits beside a sign


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> int:
    """Write `splats`; return how many could not be drawn and were left out.

    The format has no place for units and the origin: they are not written. A splat farther than
    2048 units from the centre is drawn nearer along its ray and smaller, which looks the same from
    the middle. Raises SplatError when the file cannot be written.
    """
    splats, dropped = kept_rows(splats)
    degree = int(splats.sh_degrees.max(initial=0))
    splats = _within_reach(turned(splats.with_sh_degree(degree)))
    bits = _fractional_bits(splats.means)
    header = HEADER.pack(_MAGIC, 3, len(splats), degree, bits, 0, 0)
    with (
        replacing(path) as temporary,
        temporary.open("wb") as file,
        # without a name and a time, so that equal splats give equal bytes
        gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
    ):
        packed.write(header)
        for array in _arrays(splats, bits):
            packed.write(array.tobytes())
    return dropped


def _within_reach(splats: Splats) -> Splats:
    """Splats beyond what 24 bits can hold, shrunk towards the centre together with their sizes."""
    reach = _FIXED_LIMIT / (1 << _LEAST_FRACTIONAL_BITS)
    means = splats.means.astype(np.float64)
    factors = reach / np.maximum(np.abs(means).max(axis=1, initial=0.0), reach)
    return replace(
        splats,
        means=means * factors[:, None],
        log_scales=splats.log_scales + np.log(factors)[:, None],
    )


def _fractional_bits(means: NDArray[np.floating]) -> int:
    """As many as the largest coordinate leaves: small scenes get finer steps."""
    largest = float(np.abs(means).max(initial=0.0))
    if largest == 0:
        return _LEAST_FRACTIONAL_BITS
    room = math.floor(math.log2(_FIXED_LIMIT / largest))
    return min(max(room, _LEAST_FRACTIONAL_BITS), _MOST_FRACTIONAL_BITS)


def _arrays(splats: Splats, bits: int) -> tuple[NDArray[Any], ...]:
    """The file's arrays in their order. splats: upright."""
    fixed = np.rint(splats.means * float(1 << bits)).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    colours = 255 * (_COLOUR_SCALE * splats.sh[:, 0].astype(np.float64) + 0.5)
    sh = splats.sh[:, 1:]
    steps = np.array([_SH_STEPS[math.isqrt(k) - 1] for k in range(1, 1 + sh.shape[1])], np.float64)
    levels = np.rint(128 * sh.astype(np.float64)) + 128
    levels = np.floor((levels / steps[:, None]) + 0.5) * steps[:, None]
    return (
        positions,
        _byte(255 * linear_opacities(splats)),
        _byte(colours),
        _byte(16 * (splats.log_scales.astype(np.float64) + 10)),
        _pack_rotations(splats.quaternions),
        _byte(levels),
    )


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _pack_rotations(quaternions: NDArray[np.floating]) -> NDArray[np.uint32]:
    """[N]: 2 bits name the largest of x, y, z, w; sign and 9 bits for each of the others."""
    xyzw = unit_quaternions(quaternions)[:, [1, 2, 3, 0]]
    largest, others = smallest_three.split(xyzw)
    word = largest.astype(np.uint32)
    for column in others.T:
        magnitude = np.rint(np.abs(column) / smallest_three.LIMIT * _MAGNITUDE).astype(np.uint32)
        sign = (column < 0).astype(np.uint32)
        word = word << np.uint32(10) | sign << np.uint32(9) | magnitude
    return word.astype("<u4")


def read(path: Path) -> Splats:
    """The splats of an .spz of version 2 or 3, turned to y down, float32.

    Whether they were trained with antialiasing is not kept. Raises SplatError
    "splats-unreadable" for what is damaged, or of another version.
    """
    path = Path(path)
    with reading(path), path.open("rb") as file:
        if file.read(4) == _MAGIC:
            raise BadFileError(
                "it is SPZ version 4 (packed with zstd), which is not read; save it as version 3"
            )
        file.seek(0)
        stream = Inflated(file, path.stat().st_size)
        magic, version, count, degree, bits, _, _ = HEADER.unpack(stream.read(HEADER.size))
        if magic != _MAGIC:
            raise BadFileError("it does not hold 'NGSP'")
        if version not in (2, 3):
            raise BadFileError(f"it is SPZ version {version}; 2 and 3 are read")
        if degree > 3 or bits > 31:
            raise BadFileError(f"its SH degree is {degree} and its fractional bits are {bits}")
        widths = (9, 1, 3, 3, 4 if version == 3 else 3, 3 * ((degree + 1) ** 2 - 1))
        stream.expect(count * sum(widths))
        parts = [stream.rows(count, width) for width in widths]
        stream.finish()
        return checked(turned(_unpacked(parts, version, bits)))


def _unpacked(parts: list[NDArray[np.uint8]], version: int, bits: int) -> Splats:
    """parts: [N, bytes] of each array. The splats are still upright."""
    positions, opacities, colours, scales, rotations, sh = parts
    count = len(positions)
    padded = np.zeros((count, 3, 4), np.uint8)
    padded[:, :, 1:] = positions.reshape(count, 3, 3)
    fixed = padded.view("<i4")[:, :, 0] >> 8  # the shift brings the sign down
    dc = (colours / 255 - 0.5) / _COLOUR_SCALE
    rest = (sh.reshape(count, sh.shape[1] // 3, 3).astype(np.float32) - 128) / 128
    return Splats(
        means=(fixed / float(1 << bits)).astype(np.float32),
        quaternions=_rotations(rotations, version),
        log_scales=scales.astype(np.float32) / 16 - 10,
        opacity_logits=logits_of(opacities[:, 0] / 255),
        sh=np.concatenate([dc[:, None].astype(np.float32), rest], axis=1),
        sh_degrees=np.zeros(count, np.uint8),
    )


def _rotations(packed: NDArray[np.uint8], version: int) -> NDArray[np.float32]:
    """[N, 4] w, x, y, z."""
    if version == 2:
        xyz = packed / 127.5 - 1
        w = np.sqrt(np.maximum(0.0, 1 - np.square(xyz).sum(axis=1, keepdims=True)))
        return unit_quaternions(np.concatenate([w, xyz], axis=1))
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    columns = []
    for shift in (20, 10, 0):
        part = (word >> np.uint32(shift)) & np.uint32(1023)
        magnitude = (part & np.uint32(_MAGNITUDE)) * (smallest_three.LIMIT / _MAGNITUDE)
        columns.append(np.where(part >> np.uint32(9), -magnitude, magnitude))
    xyzw = smallest_three.join(word >> np.uint32(30), np.stack(columns, axis=1))
    return xyzw[:, [3, 0, 1, 2]]
