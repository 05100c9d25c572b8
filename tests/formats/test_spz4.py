"""SPZ version 4, from files that other programs wrote.

The files in spz4/ were made from `many_splats(40).with_sh_degree(d)`, written here as version 3:
`adobe_*` read and saved as version 4 (from RUB, 5 and 4 bits of SH) by the npm package @adobe/spz
0.2.3, `gsply_*` by the PyPI package gsply 0.4.6 with write_spz(version=4).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.formats import spz_read
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
        (12, b"\4", "degree is 4"),
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
    zstandard = pytest.importorskip("zstandard")
    count = 20_000_000
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 3, 12, 0, 6, 32)
    sizes = spz_read.Header.of(head).widths
    packed = zstandard.compress(bytes(1 << 20))
    table = b"".join(struct.pack("<QQ", len(packed), count * size) for size in sizes)
    (tmp_path / "a.spz").write_bytes(head + table + packed * 6)
    with pytest.raises(SplatError, match="declares"):
        formats.read(tmp_path / "a.spz")


def test_a_stream_that_holds_more_than_it_declares_is_refused(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
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
