"""SPZ version 4: files that other programs wrote, and ours.

The files in spz4/ were made from `many_splats(40).with_sh_degree(d)`, written here as version 3:
`adobe_*` read and saved as version 4 (from RUB, 5 and 4 bits of SH) by the npm package @adobe/spz
0.2.3, `gsply_*` by the PyPI package gsply 0.4.6 with write_spz(version=4).
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import gsply
import numpy as np
import pytest
import zstandard

from stages import formats
from stages.base.errors import SplatError
from stages.formats import spz_read
from stages.proof.checks import read_back
from tests.formats.truth import many_splats

FOLDER = Path(__file__).parent / "spz4"
HALF_A_STEP = 0.5 / 4096 + 1e-6


@pytest.mark.parametrize(
    ("name", "degree"), [("adobe_degree_0", 0), ("gsply_degree_2", 2), ("adobe_degree_3", 3)]
)
def test_version_4_holds_what_version_3_held(tmp_path: Path, name: str, degree: int) -> None:
    truth = many_splats(40).with_sh_degree(degree)
    formats.write(tmp_path / "a.spz", truth)
    older, back = formats.read(tmp_path / "a.spz"), formats.read(FOLDER / f"{name}.spz")
    np.testing.assert_allclose(back.means, truth.means, atol=HALF_A_STEP)
    for field in ("quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees"):
        np.testing.assert_array_equal(getattr(back, field), getattr(older, field))


def changed(tmp_path: Path, at: int, new: bytes, insert: bytes = b"") -> Path:
    """A file with bytes of its header changed, and with records of extensions."""
    content = bytearray((FOLDER / "adobe_degree_3.spz").read_bytes())
    content[at : at + len(new)] = new
    if insert:
        content[14] |= 2
        content[16:20] = struct.pack("<I", 32 + len(insert))
    path = tmp_path / "a.spz"
    path.write_bytes(bytes(content[:32]) + insert + bytes(content[32:]))
    return path


@pytest.mark.parametrize(
    ("at", "new", "word"),
    [
        (4, struct.pack("<I", 5), "version 5"),
        (8, struct.pack("<I", 41), "declares"),
        (8, struct.pack("<I", 0xFFFFFFFF), "declares"),
        (12, b"\5", "degree is 5"),
        (13, b"\x40", "fractional"),
        (15, b"\2", "2 streams"),
        (15, b"\xff", "declares|cut short|damaged"),
        (16, struct.pack("<I", 0), "table starts at 0"),
        (16, struct.pack("<I", 0xFFFFFFF0), "table starts"),
        (32, struct.pack("<Q", 1 << 60), "cut short"),
        (40, struct.pack("<Q", 1 << 60), "declares"),
        (140, b"\xff\xff\xff\xff", "damaged"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, at: int, new: bytes, word: str) -> None:
    with pytest.raises(SplatError, match=word) as caught:
        formats.read(changed(tmp_path, at, new))
    assert caught.value.code == "splats-unreadable"


def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path) -> None:
    whole = (FOLDER / "adobe_degree_3.spz").read_bytes()
    for cut in (5, 20, 31, 33, 100, 127, 129, 600, len(whole) - 1):
        (tmp_path / "a.spz").write_bytes(whole[:cut])
        with pytest.raises(SplatError, match=r"cut short|damaged"):
            formats.read(tmp_path / "a.spz")


def test_a_bomb_is_refused_before_it_unpacks(tmp_path: Path) -> None:
    count = 20_000_000
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 3, 12, 0, 6, 32)
    sizes = spz_read.Header.of(head).widths
    packed = zstandard.compress(bytes(1 << 20))
    table = b"".join(struct.pack("<QQ", len(packed), count * size) for size in sizes)
    (tmp_path / "a.spz").write_bytes(head + table + packed * 6)
    with pytest.raises(SplatError, match="declares"):
        formats.read(tmp_path / "a.spz")


def test_a_stream_that_holds_more_than_it_declares_is_refused(tmp_path: Path) -> None:
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 0, 12, 0, 5, 32)
    streams = [zstandard.compress(bytes(size + (size == 9) * 999)) for size in (9, 1, 3, 3, 4)]
    sizes = zip(streams, (9, 1, 3, 3, 4), strict=True)
    table = b"".join(struct.pack("<QQ", len(stream), size) for stream, size in sizes)
    (tmp_path / "a.spz").write_bytes(head + table + b"".join(streams))
    with pytest.raises(SplatError, match="more than"):
        formats.read(tmp_path / "a.spz")


def axes(code: int) -> bytes:
    """The record SPZ_ADOBE_coordinate_system, as @adobe/spz 0.2.3 reads it."""
    return struct.pack("<III", 0xADBE0003, 4, code)


def test_axes_that_a_file_names_are_those_it_is_read_in(tmp_path: Path) -> None:
    usual = formats.read(FOLDER / "adobe_degree_3.spz").means
    other = struct.pack("<II", 0xADBE0002, 12) + bytes(12)  # limits for cameras
    upright = formats.read(changed(tmp_path, 0, b"", other + axes(4)))
    np.testing.assert_array_equal(upright.means, usual)
    ours = formats.read(changed(tmp_path, 0, b"", axes(6)))  # right, down, front
    np.testing.assert_array_equal(ours.means, usual * [1, -1, -1])
    with pytest.raises(SplatError, match="axes"):
        formats.read(changed(tmp_path, 0, b"", axes(9)))


@pytest.mark.parametrize("count", [0, 1, 2, 70])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_file_holds_the_arrays_of_version_3(tmp_path: Path, count: int, degree: int) -> None:
    splats = many_splats(70).with_sh_degree(degree).take(slice(count))
    formats.write(tmp_path / "a.spz", splats)
    formats.write(tmp_path / "a.v4.spz", splats)
    older = gzip.decompress((tmp_path / "a.spz").read_bytes())
    whole = (tmp_path / "a.v4.spz").read_bytes()
    degree = older[12]
    streams = 6 if degree else 5
    assert whole[:16] == older[:4] + b"\4\0\0\0" + older[8:15] + bytes([streams])
    assert whole[16:32] == struct.pack("<I", 32) + bytes(12)
    start, arrays = 32 + 16 * streams, b""
    for packed, size in struct.iter_unpack("<QQ", whole[32:start]):
        frame = whole[start : start + packed]
        assert zstandard.frame_content_size(frame) == size
        arrays += zstandard.ZstdDecompressor().decompress(frame)
        start += packed
    assert start == len(whole)
    assert arrays == older[16:]


def test_another_reader_finds_the_same_values(tmp_path: Path) -> None:
    path = tmp_path / "a.v4.spz"
    formats.write(path, many_splats(70))
    other, back = gsply.read_spz(path), formats.read(path)
    np.testing.assert_allclose(other.means * [1, -1, -1], back.means, atol=1e-6)
    np.testing.assert_allclose(other.scales, back.log_scales, atol=1e-6)
    np.testing.assert_allclose(other.opacities, back.opacity_logits, atol=1e-4)
    np.testing.assert_allclose(other.sh0, back.sh[:, 0], atol=1e-5)


def of_version_4(tmp_path: Path, count: int, degree: int, fill: int = 128) -> Path:
    """A file whose arrays are full of one byte; arrays of no bytes are left out, as the reference
    library does."""
    sizes = [count * width for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))]
    frames = [(zstandard.compress(bytes([fill]) * size), size) for size in sizes if size]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(frames), 32)
    table = b"".join(struct.pack("<QQ", len(frame), size) for frame, size in frames)
    path = tmp_path / "a.spz"
    path.write_bytes(head + table + b"".join(frame for frame, _ in frames))
    return path


def test_the_degrees_to_3_of_degree_4_are_read(tmp_path: Path) -> None:
    path = of_version_4(tmp_path, 3, 4, 144)
    for back in (formats.read(path), read_back(path).splats):
        assert (len(back), back.sh_degree) == (3, 3)
        np.testing.assert_array_equal(np.abs(back.sh[:, 1:]), 1 / 8)


def test_a_file_without_splats_and_arrays_is_read(tmp_path: Path) -> None:
    assert len(formats.read(of_version_4(tmp_path, 0, 0))) == 0
