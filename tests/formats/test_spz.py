"""SPZ against its specification, written out again here, and files of other versions."""

from __future__ import annotations

import gzip
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.formats import spz_read
from stages.proof.checks import read_back
from stages.proof.prover import Prover, cameras_for
from stages.scene import Splats
from stages.scene.quantiles import median_spacing
from tests.formats.files import angles
from tests.formats.truth import C0, extreme_splats, many_splats, red_splat


def content_of(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes())


def test_every_byte_is_that_of_the_specification(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    formats.write(path, red_splat())
    content = content_of(path)
    # largest coordinate 3: 3 x 2^21 is below 2^23, 3 x 2^22 is not
    assert struct.unpack_from("<IIIBBBB", content) == (0x5053474E, 3, 1, 1, 21, 0, 0)
    x, y, z = (
        int.from_bytes(content[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3)
    )
    assert (x, y, z) == (1 << 21, -2 << 21, -3 << 21)  # right, up, back
    assert content[25] == 191  # 255 x 0.75
    wanted = [255 * (0.5 + 0.15 * (v - 0.5) / C0) for v in (0.9, 0.1, 0.2)]
    assert list(content[26:29]) == [round(v) for v in wanted]
    assert list(content[29:32]) == [round(16 * (math.log(s) + 10)) for s in (0.1, 0.2, 0.4)]
    # turned about x, y and z of the quaternion change sign; w, the last of x y z w, is the largest
    units = [round(511 * math.sqrt(2) * v) for v in (1 / 6, 1 / 3, 1 / 3)]
    word = 3 << 30 | units[0] << 20 | 1 << 19 | units[1] << 10 | 1 << 9 | units[2]
    assert content[32:36] == struct.pack("<I", word)
    # -C1 y and C1 z change sign, -C1 x not; 128 + 128 c in steps of 8: 0.3, -0.1 and 0.2
    assert list(content[36:]) == [128, 168, 128, 112, 128, 128, 128, 128, 152]


def test_files_of_version_2_are_the_same_to_two_readers(tmp_path: Path) -> None:
    splats = many_splats(60)
    xyzw = splats.quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw *= np.sign(xyzw[:, 3:]) / np.linalg.norm(xyzw, axis=1, keepdims=True)
    formats.write(tmp_path / "a.spz", splats)
    content = bytearray(content_of(tmp_path / "a.spz"))
    assert content[4] == 3
    content[4] = 2
    start = 16 + 60 * (9 + 1 + 3 + 3)  # rotations follow positions, opacities, colours and sizes
    xyz = np.rint((xyzw[:, :3] + 1) * 127.5).astype(np.uint8)
    content[start : start + 60 * 4] = xyz.tobytes()
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(content)))
    back = formats.read(tmp_path / "a.spz")
    proof = Prover.of(back, cameras_for(back)).prove(tmp_path / "a.spz")
    assert proof.fault == ""
    assert proof.figures["verify_db"] > 80
    assert proof.figures["max_rotation_error_degrees"] < 1e-3


def test_a_file_of_version_2_is_read_as_the_specification_says(tmp_path: Path) -> None:
    header = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 1, 0)
    positions = b"".join(v.to_bytes(3, "little", signed=True) for v in (4096, -8192, 2048))
    body = positions + bytes([64]) + bytes([255, 0, 128]) + bytes([160, 144, 176])
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header + body + bytes([191, 64, 128])))
    back = formats.read(path)
    np.testing.assert_allclose(back.means, [[1, 2, -0.5]])
    np.testing.assert_allclose(back.opacities, [64 / 255], atol=1e-6)
    np.testing.assert_allclose(back.log_scales, [[0, -1, 1]])
    np.testing.assert_allclose(
        back.sh[0, 0], [0.5 / 0.15, -0.5 / 0.15, 0.5 / 255 / 0.15], rtol=1e-4
    )
    x, y, z = (191 / 127.5 - 1, 64 / 127.5 - 1, 128 / 127.5 - 1)
    w = math.sqrt(1 - x * x - y * y - z * z)
    np.testing.assert_allclose(back.quaternions, [[w, x, -y, -z]], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back_within_half_a_step(tmp_path: Path, degree: int) -> None:
    splats = many_splats(500).with_sh_degree(degree)
    path = tmp_path / "a.spz"
    formats.write(path, splats)
    back = formats.read(path)
    bits = content_of(path)[13]
    assert 2 ** (22 - bits) <= np.abs(splats.means).max() < 2 ** (23 - bits)
    np.testing.assert_allclose(back.means, splats.means, atol=0.5 / 2**bits + 1e-6)
    wanted = np.clip(splats.log_scales, -10, 255 / 16 - 10)
    np.testing.assert_allclose(back.log_scales, wanted, atol=1 / 32 + 1e-5)
    wanted = np.clip(splats.opacities, 1 / 255, 254 / 255)
    np.testing.assert_allclose(back.opacities, wanted, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(back.sh[:, 0], splats.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-5)
    # 9 bits over 1/sqrt 2: three errors of 1/1445, and the fourth what they make of the length
    assert angles(splats.quaternions, back.quaternions).max() < 0.3
    # steps of 8/128 and 16/128; the highest level is 255, half a step short of 1; beyond it no more
    sh = np.clip(splats.sh[:, 1:], -1, 1)
    for band, half in ((slice(0, 3), 1 / 32), (slice(3, 15), 1 / 16)):
        np.testing.assert_allclose(back.sh[:, 1:][:, band], sh[:, band], atol=half + 0.5 / 128)
    np.testing.assert_array_equal(back.sh[splats.sh == 0], 0)
    assert len(content_of(path)) == 16 + 500 * (20 + 3 * ((degree + 1) ** 2 - 1))


def test_a_small_scene_keeps_its_positions(tmp_path: Path) -> None:
    """Steps of 1/4096 would leave a scene of 2 mm in metres with eight places."""
    splats = many_splats(200)
    small = replace(splats, means=splats.means * np.float32(1e-3))
    formats.write(tmp_path / "a.spz", small)
    error = np.abs(formats.read(tmp_path / "a.spz").means - small.means).max()
    assert error < 1e-7


def test_terrain_wider_than_2048_units_keeps_its_positions(tmp_path: Path) -> None:
    splats = many_splats(2000)
    splats.means[:] = np.random.default_rng(1).uniform(-3000, 3000, (2000, 3))
    formats.write(tmp_path / "a.spz", splats)
    assert content_of(tmp_path / "a.spz")[13] == 11
    back = formats.read(tmp_path / "a.spz")
    np.testing.assert_allclose(back.means, splats.means, atol=0.5 / 2**11 + 1e-3)


def test_an_outlier_does_not_coarsen_the_steps_of_the_others(tmp_path: Path) -> None:
    splats = many_splats(2000)
    splats.means[4] = (1e6, -5e5, 2e5)
    formats.write(tmp_path / "a.spz", splats)
    bits = content_of(tmp_path / "a.spz")[13]
    assert 2.0**-bits <= median_spacing(splats.means) / 16 < 2.0 ** (1 - bits)
    error = np.abs(formats.read(tmp_path / "a.spz").means - splats.means)
    assert np.delete(error, 4, axis=0).max() <= 0.5 / 2**bits + 1e-6


def test_a_scene_far_from_zero_gets_the_steps_that_reach_it(tmp_path: Path) -> None:
    """On a map grid, with neighbours closer than 16 of these steps."""
    splats = many_splats(2000)
    splats.means[:] = splats.means * 0.1 + np.array([2e4, 1e4, 1e2], np.float32)
    formats.write(tmp_path / "a.spz", splats)
    assert content_of(tmp_path / "a.spz")[13] == 8
    error = np.abs(formats.read(tmp_path / "a.spz").means - splats.means)
    assert error.max() <= 0.5 / 2**8 + 1e-3


def test_what_lies_beyond_reach_looks_the_same_from_the_middle(tmp_path: Path) -> None:
    splats = many_splats(9)
    splats.means[4] = (1e9, -5e8, 2e8)
    splats.log_scales[4] = 10
    formats.write(tmp_path / "a.spz", splats)
    back = formats.read(tmp_path / "a.spz")
    bits = content_of(tmp_path / "a.spz")[13]
    assert np.abs(back.means[4]).max() == pytest.approx(2 ** (23 - bits), rel=1e-5)
    along = back.means[4] / np.linalg.norm(back.means[4])
    np.testing.assert_allclose(along, splats.means[4] / np.linalg.norm(splats.means[4]), atol=1e-6)
    size, wanted = (np.exp(s.log_scales[4]) / np.linalg.norm(s.means[4]) for s in (back, splats))
    np.testing.assert_allclose(size, wanted, rtol=1 / 32)
    np.testing.assert_allclose(back.means[:4], splats.means[:4], atol=0.5 / 2**bits + 1e-6)


def test_extremes_stay_finite(tmp_path: Path) -> None:
    splats = extreme_splats(1)
    splats.sh[2, 0] = 3.4e38
    assert formats.write(tmp_path / "a.spz", splats) == 0
    back = formats.read(tmp_path / "a.spz")
    assert len(back) == 4
    np.testing.assert_allclose(255 * back.opacities, [254, 1, 254, 1], atol=1e-4)
    assert angles(splats.quaternions, back.quaternions).max() < 0.3


def test_opacities_stay_clear_of_the_bytes_whose_logit_is_infinite(tmp_path: Path) -> None:
    splats = many_splats(5)
    splats.opacity_logits[:] = [-100, -6.5, 0, 6.5, 100]
    formats.write(tmp_path / "a.spz", splats)
    assert list(content_of(tmp_path / "a.spz")[16 + 5 * 9 :][:5]) == [1, 1, 128, 254, 254]


def test_bytes_of_other_writers_whose_logit_is_infinite_are_read_as_numbers(tmp_path: Path) -> None:
    path = packed(many_splats(2), tmp_path, 16 + 2 * 9, b"\0\xff")
    for back in (formats.read(path), read_back(path).splats):
        assert np.isfinite(back.opacity_logits).all()
        np.testing.assert_allclose(back.opacities, [0, 1], atol=1e-6)


def packed(splats: Splats, tmp_path: Path, at: int, new: bytes, extra: bytes = b"") -> Path:
    """A file whose unpacked content was changed."""
    path = tmp_path / "a.spz"
    formats.write(path, splats)
    content = bytearray(content_of(path))
    content[at : at + len(new)] = new
    path.write_bytes(gzip.compress(bytes(content) + extra))
    return path


@pytest.mark.parametrize(
    ("at", "new", "word"),
    [
        (0, b"XGSP", "NGSP"),
        (4, b"\1", "version 1"),
        (4, b"\4", "version 4"),
        (8, b"\xff\xff\xff\xff", "declares"),
        (8, b"\xff\xff\0\0", "cut short"),
        (12, b"\5", "degree is 5"),
        (12, b"\xff", "degree is 255"),
        (13, b"\xff", "fractional"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, at: int, new: bytes, word: str) -> None:
    with pytest.raises(SplatError, match=word) as caught:
        formats.read(packed(many_splats(5), tmp_path, at, new))
    assert caught.value.code == "splats-unreadable"


def test_what_follows_the_splats_is_passed_over_but_not_without_end(tmp_path: Path) -> None:
    splats = many_splats(5)
    assert len(formats.read(packed(splats, tmp_path, 0, b"N", extra=b"x" * 999))) == 5
    with pytest.raises(SplatError, match="more than its header"):
        formats.read(packed(splats, tmp_path, 0, b"N", extra=bytes(300 << 20)))


def test_a_gzip_bomb_is_refused_before_it_unpacks(tmp_path: Path) -> None:
    header = spz_read.HEADER.pack(b"NGSP", 3, 20_000_000, 3, 12, 0, 0)
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header + bytes(100 << 20), 1))
    with pytest.raises(SplatError, match="declares"):
        formats.read(path)
