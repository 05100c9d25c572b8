"""Reads SPZ versions 2, 3 and 4, written by this project or by other programs.

The arrays are those of `spz`. Versions 2 and 3: gzip around a header of 16 bytes and the arrays;
rotations of version 2 are x, y, z as uint8. Version 4: an uncompressed header of 32 bytes, records
of extensions, a table of (packed, unpacked) sizes as uint64, and one zstd frame an array; empty
arrays may be left out. Of SH of degree 4, degrees to 3 are kept. Specification: nianticlabs/spz,
README.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.base.row_slices import row_slices
from stages.formats import smallest_three
from stages.formats.inflate import check_size, read_rest, read_rows, read_zstd_frame
from stages.formats.values import allocate, logits_of, unit_quaternions
from stages.scene import Splats
from stages.scene.flip import flipped

HEADER = struct.Struct("<4sIIBBBB")
MAGIC = b"NGSP"
COLOUR_SCALE = 0.15
MAGNITUDE = 511  # 9 bits beside a sign
_MOST_DEGREE, _KEPT_DEGREE = 4, 3  # of SH: in files, and in `Splats`
TABLE_STARTS = struct.Struct("<I12x")  # follows HEADER in version 4, whose last byte is a count
TABLE_ROW, _RECORD = struct.Struct("<QQ"), struct.Struct("<II")
ANTIALIASED, _HAS_EXTENSIONS = 1, 2  # in the flags
_EXTENSIONS_LIMIT_BYTES = 1 << 20
# SPZ_ADOBE_coordinate_system: axes other than right, up, back. Codes of the reference library:
# 0 unspecified, 4 right up back, 6 right down front, which are ours.
_AXES_EXTENSION, _Y_UP, _OURS = 0xADBE0003, (0, 4), 6


class Header(NamedTuple):
    """The values of `HEADER`. splats: how many; streams: how many follow in version 4."""

    magic: bytes
    version: int
    splats: int
    degree: int
    bits: int
    flags: int
    streams: int

    @classmethod
    def of(cls, content: bytes) -> Header:
        """The header that `content` begins with."""
        return cls(*HEADER.unpack_from(content))

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes a splat takes in each array: positions, opacities, colours, scales, rotations, SH.
        Raises BadFileError for a degree or a precision that no file has."""
        degree, bits = self.degree, self.bits
        if degree > _MOST_DEGREE or bits > 31:
            raise BadFileError(f"its SH degree is {degree} and its fractional bits are {bits}")
        return (9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * ((degree + 1) ** 2 - 1))


# header, extensions, arrays [N, bytes]
_Content = tuple[Header, bytes, list[NDArray[np.uint8]]]


def read(path: Path) -> Splats:
    """The splats of an .spz, y down, float32.

    Raises BadFileError for a damaged file or another version.
    """
    with path.open("rb") as file:
        splats, extensions = unpack(file, path.stat().st_size)
    return flipped(splats, reuse=True) if _is_y_up(extensions) else splats


def unpack(file: BinaryIO, size: int) -> tuple[Splats, bytes]:
    """(the splats in the axes that they are stored in, the records of extensions) of an open file
    of `size` bytes. Raises as `read`."""
    file.seek(0)
    streams = file.read(len(MAGIC)) == MAGIC
    file.seek(0)
    head, extensions, arrays = _of_streams(file, size) if streams else _gzipped(file, size)
    splats = _decoded(head, arrays).with_antialias(bool(head.flags & ANTIALIASED))
    return splats, extensions if head.flags & _HAS_EXTENSIONS else b""


def _gzipped(file: BinaryIO, size: int) -> _Content:
    stream = gzip.GzipFile(fileobj=file)
    head = Header.of(read_rows(stream, 1, HEADER.size).tobytes())
    if head.magic != MAGIC:
        raise BadFileError("it does not hold 'NGSP'")
    if head.version not in (2, 3):
        raise BadFileError(f"it is SPZ version {head.version} in gzip; there 2 and 3 are read")
    check_size(head.splats * sum(head.widths), size)
    arrays = [read_rows(stream, head.splats, width) for width in head.widths]
    return head, read_rest(stream), arrays


def _of_streams(file: BinaryIO, size: int) -> _Content:
    head, extensions, table = _table(file, size)
    sizes, count = head.widths, head.splats
    check_size(count * sum(sizes), size)
    if head.streams < sum(count * width > 0 for width in sizes):
        raise BadFileError(f"it has {head.streams} streams for {len(sizes)} arrays")
    arrays = []
    table += [(0, 0)] * len(sizes)  # arrays that are left out
    for width, (packed, declared) in zip(sizes, table, strict=False):
        if declared != count * width:
            raise BadFileError(f"it declares {declared} bytes for {count} times {width}")
        if packed > size:
            raise BadFileError("it is cut short")
        arrays.append(read_zstd_frame(file, packed, declared).reshape(count, width))
    return head, extensions, arrays


def _table(file: BinaryIO, size: int) -> tuple[Header, bytes, list[tuple[int, int]]]:
    """(header, extensions, (packed, unpacked) bytes of each stream) of a file of version 4. The
    file position is then at the streams."""
    head = file.read(HEADER.size + TABLE_STARTS.size)
    if len(head) < HEADER.size + TABLE_STARTS.size:
        raise BadFileError("it is cut short")
    values = Header.of(head)
    (starts,) = TABLE_STARTS.unpack_from(head, HEADER.size)
    if values.version != 4:
        raise BadFileError(f"it is SPZ version {values.version} without gzip; there 4 is read")
    if not 0 <= starts - len(head) <= min(_EXTENSIONS_LIMIT_BYTES, size):
        raise BadFileError(f"its table starts at {starts}")
    extensions = file.read(starts - len(head))
    table = file.read(values.streams * TABLE_ROW.size)
    if len(table) < values.streams * TABLE_ROW.size:
        raise BadFileError("it is cut short")
    return values, extensions, list(TABLE_ROW.iter_unpack(table))


def _is_y_up(records: bytes) -> bool:
    """Whether the axes are right, up, back; False if they are ours. Other extensions (limits for
    cameras) are ignored. Raises BadFileError for other axes."""
    at = 0
    while len(records) >= at + _RECORD.size:
        kind, length = _RECORD.unpack_from(records, at)
        at += _RECORD.size + length
        if kind == _AXES_EXTENSION:
            axes = int.from_bytes(records[at - length : at], "little")
            if axes not in (*_Y_UP, _OURS):
                raise BadFileError(f"its axes are number {axes} of SPZ, which is not supported")
            return axes != _OURS
    return True


def _decoded(head: Header, arrays: list[NDArray[np.uint8]]) -> Splats:
    """The splats in the axes of the file."""
    positions, opacities, colours, scales, rotations, sh = arrays
    splats = allocate(len(positions), min(head.degree, _KEPT_DEGREE))
    for rows in row_slices(len(positions)):
        out = splats.take(rows)
        padded = np.zeros((len(out), 3, 4), np.uint8)
        padded[:, :, 1:] = positions[rows].reshape(-1, 3, 3)
        fixed = padded.view("<i4")[:, :, 0] >> 8  # the shift extends the sign
        out.means[:] = fixed / float(1 << head.bits)
        out.quaternions[:] = _rotations(rotations[rows], head.version)
        out.log_scales[:] = scales[rows].astype(np.float32) / 16 - 10
        out.opacity_logits[:] = logits_of(opacities[rows, 0] / 255)
        out.sh[:, 0] = (colours[rows] / 255 - 0.5) / COLOUR_SCALE
        kept = sh[rows].reshape(len(out), -1, 3)[:, : out.sh.shape[1] - 1]
        out.sh[:, 1:] = (kept.astype(np.float32) - 128) / 128
    return splats


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
        magnitude = (part & np.uint32(MAGNITUDE)) * (smallest_three.LIMIT / MAGNITUDE)
        columns.append(np.where(part >> np.uint32(9), -magnitude, magnitude))
    xyzw = smallest_three.join(word >> np.uint32(30), np.stack(columns, axis=1))
    return xyzw[:, [3, 0, 1, 2]]
