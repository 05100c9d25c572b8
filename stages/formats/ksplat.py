"""Reads .ksplat, the files of the viewer GaussianSplats3D. Nothing writes them here.

A header of 4096 bytes, a header of 1024 bytes for each section, then the sections: the sizes of
buckets that are not full, the centres of buckets, and one record a splat. Compression level 0 holds
float32; 1 holds positions as uint16 around the centre of their bucket and float16; 2 as 1, with SH
in bytes of a range that the header states. Scales are linear, rotations w, x, y, z, colours and
opacities bytes, SH channel by channel in each degree, to degree 2. Axes are those of the .ply.
Definition: mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js (MIT), release 0.4.7.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.base.errors import UsageError
from stages.base.row_slices import row_slices
from stages.formats.values import allocate, log_scales_of, logits_of
from stages.scene import Splats, rgb_to_dc

# version, -, sections, -, -, splats, level, -, the centre of the scene, the range of SH
_HEADER, _HEADER_BYTES = struct.Struct("<BBxxIIIIHxx12xff"), 4096
# splats, room for splats, bucket size, buckets, block size, bytes of a centre, steps, -, full
# buckets, others, SH degree
_SECTION, _SECTION_BYTES = struct.Struct("<IIIIfHxxIIIIH"), 1024
_USUAL_SH, _USUAL_STEPS = 1.5, 32767
_POSITIONS, _VALUES, _SH = ("<f4", "<u2", "<u2"), ("<f4", "<f2", "<f2"), ("<f4", "<f2", "u1")


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Raises SplatError "format-read-only"."""
    raise UsageError(
        "format-read-only",
        given=f"{path.name} would be a .ksplat, which is read and not written.",
        wanted="A format that is written.",
        hint="GaussianSplats3D reads .ply and .splat, too.",
    )


@dataclass(frozen=True)
class _Section:
    """records: of the splats, not copied. centres: of the buckets. sizes: how many splats are in
    each. step: of positions. degree: of SH."""

    records: NDArray[np.void]
    centres: NDArray[np.float32]
    sizes: NDArray[np.int64]
    step: float
    steps: int
    degree: int


def read(path: Path) -> Splats:
    """The splats, y down, float32. Raises BadFileError for a damaged file."""
    content = np.memmap(path, np.uint8, "r")
    if len(content) < _HEADER_BYTES:
        raise BadFileError("it is cut short")
    major, _, sections, _, _, _, level, low, high = _HEADER.unpack_from(content.data)
    if major != 0 or level >= len(_SH):
        raise BadFileError(f"its version is {major} and its compression level is {level}")
    sh_range = low or -_USUAL_SH, high or _USUAL_SH
    found = list(_sections(content, sections, level))
    splats = allocate(sum(len(s.records) for s in found), max((s.degree for s in found), default=0))
    start = 0
    for section in found:
        for rows in row_slices(len(section.records)):
            out = splats.take(slice(start + rows.start, start + rows.stop))
            _decode(section, rows, sh_range, out)
        start += len(section.records)
    return splats


def _sections(content: NDArray[np.uint8], count: int, level: int) -> Iterator[_Section]:
    """The sections of a file. Raises BadFileError for one that reaches past it."""
    start = _HEADER_BYTES + count * _SECTION_BYTES
    if start > len(content):
        raise BadFileError("it is cut short")
    for number in range(count):
        splats, room, size, buckets, block, centre, steps, _, full, others, degree = (
            _SECTION.unpack_from(content.data, _HEADER_BYTES + number * _SECTION_BYTES)
        )
        if degree > 2 or splats > room or (buckets and centre != 12):
            raise BadFileError(f"section {number} has a header that no file has")
        record = np.dtype(
            [
                ("position", _POSITIONS[level], 3),
                ("scale", _VALUES[level], 3),
                ("rotation", _VALUES[level], 4),
                ("colour", "u1", 4),
                ("sh", _SH[level], (3 * ((degree + 1) ** 2 - 1),)),
            ]
        )
        ends = start + np.cumsum([4 * others, 12 * buckets, record.itemsize * room])
        if ends[-1] > len(content):
            raise BadFileError("it is cut short")
        sizes = content[start : ends[0]].view("<u4").astype(np.int64)
        sizes = np.concatenate([np.full(min(full, buckets), size, np.int64), sizes])
        if level and not (len(sizes) == buckets and sizes.sum() == splats):
            raise BadFileError(f"the buckets of section {number} do not hold its splats")
        steps = steps or _USUAL_STEPS
        yield _Section(
            content[ends[1] : ends[2]].view(record)[:splats],
            content[ends[0] : ends[1]].view("<f4").reshape(-1, 3),
            sizes if level else np.zeros(0, np.int64),
            block / 2 / steps,
            steps,
            degree,
        )
        start = int(ends[2])


def _decode(section: _Section, rows: slice, sh_range: tuple[float, float], out: Splats) -> None:
    """Fill `out` with the splats in some rows of a section."""
    records = section.records[rows]
    positions: NDArray[np.float64] = records["position"].astype(np.float64)
    if len(section.sizes):
        ends = np.cumsum(section.sizes)
        bucket = np.searchsorted(ends, np.arange(rows.start, rows.start + len(records)), "right")
        positions = (positions - section.steps) * section.step + section.centres[bucket]
    out.means[:] = positions
    out.quaternions[:] = records["rotation"]
    out.log_scales[:] = log_scales_of(records["scale"].astype(np.float32))
    out.opacity_logits[:] = logits_of(records["colour"][:, 3] / 255)
    out.sh[:] = 0
    out.sh[:, 0] = rgb_to_dc(records["colour"][:, :3] / 255)
    sh: NDArray[np.floating] = records["sh"].astype(np.float32)
    if records["sh"].dtype.kind == "u":
        sh = sh_range[0] + sh / 255 * (sh_range[1] - sh_range[0])
    for degree in range(1, section.degree + 1):
        first, last = degree**2, (degree + 1) ** 2
        channels = sh[:, 3 * (first - 1) : 3 * (last - 1)].reshape(len(sh), 3, last - first)
        out.sh[:, first:last] = channels.transpose(0, 2, 1)
