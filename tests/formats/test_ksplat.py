"""Files of GaussianSplats3D.

Those in ksplat/ were made from `many_splats(40)` with the origin 0, written here as .ply, by
`PlyLoader.loadFromFileData` of the npm package @mkkellogg/gaussian-splats-3d 0.4.7: compression
level 0, 1 and 2, SH degree 2, blocks of 5 units, buckets of 16 splats. splat-transform 3.7.0 finds
the values that are found here.
"""

from __future__ import annotations

import shutil
import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.proof.prover import Prover, cameras_for
from tests.formats.files import angles
from tests.formats.truth import many_splats

FOLDER = Path(__file__).parent / "ksplat"
TRUTH = replace(many_splats(40).with_sh_degree(2), origin=np.zeros(3))
# A step is half a block over 32767; a float16 has 11 bits, and so has a rotation's largest part.
STEP, HALF_FLOAT, HALF_FLOAT_DEGREES = 2.5 / 32767, 2.0**-10, 0.1
# The viewer cuts the decimals of colours and of SH off; SH of these splats span 2.1.
BYTE, SH_BYTE = 1 / 255, 2.1 / 255


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_is_read(level: int) -> None:
    back = formats.read(FOLDER / f"level_{level}.ksplat")
    distances = np.linalg.norm(back.means[:, None] - TRUTH.means[None], axis=2)
    truth = TRUTH.take(distances.argmin(axis=1))
    assert sorted(distances.argmin(axis=1)) == list(range(40))
    np.testing.assert_allclose(back.means, truth.means, atol=STEP if level else 0)
    scales = HALF_FLOAT if level else 1e-6
    np.testing.assert_allclose(back.log_scales, truth.log_scales, atol=scales)
    assert angles(back.quaternions, truth.quaternions).max() < HALF_FLOAT_DEGREES
    np.testing.assert_allclose(back.opacities, truth.opacities, atol=BYTE)
    rgb, wanted = (np.clip(0.5 + 0.2820948 * s.sh[:, 0], 0, 1) for s in (back, truth))
    np.testing.assert_allclose(rgb, wanted, atol=BYTE)
    errors = np.abs(back.sh[:, 1:] - truth.sh[:, 1:])
    assert errors.max() < (0, HALF_FLOAT, SH_BYTE)[level] + 1e-9


def test_it_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(SplatError) as refused:
        formats.write(tmp_path / "a.ksplat", TRUTH)
    assert refused.value.code == "format-read-only"
    assert list(tmp_path.iterdir()) == []


def changed(tmp_path: Path, level: int, at: int, new: bytes) -> Path:
    content = bytearray((FOLDER / f"level_{level}.ksplat").read_bytes())
    content[at : at + len(new)] = new
    (tmp_path / "a.ksplat").write_bytes(content)
    return tmp_path / "a.ksplat"


@pytest.mark.parametrize(
    ("at", "new"),
    [
        (0, b"\1"),  # version
        (4, struct.pack("<I", 0xFFFFFFFF)),  # sections
        (20, b"\3"),  # compression level
        (4096, struct.pack("<I", 41)),  # splats of the section
        (4100, struct.pack("<I", 0xFFFFFFFF)),  # room for splats
        (4104, struct.pack("<I", 0xFFFFFFFF)),  # size of a bucket
        (4108, struct.pack("<I", 0xFFFFFFFF)),  # buckets
        (4112, struct.pack("<f", float("nan"))),  # size of a block
        (4116, b"\0"),  # bytes of a centre
        (4128, struct.pack("<I", 0xFFFFFFFF)),  # full buckets
        (4132, struct.pack("<I", 0xFFFFFFFF)),  # other buckets
        (4136, b"\3"),  # SH degree
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, at: int, new: bytes) -> None:
    with pytest.raises(SplatError) as refused:
        formats.read(changed(tmp_path, 1, at, new))
    assert refused.value.code == "splats-unreadable"


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, level: int) -> None:
    path = tmp_path / "a.ksplat"
    shutil.copy(FOLDER / f"level_{level}.ksplat", path)
    whole = path.read_bytes()
    for cut in (0, 1, 20, 4095, 4096, 5119, 5121, 5200, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(SplatError) as refused:
            formats.read(path)
        assert refused.value.code == "splats-unreadable"


def test_noise_is_refused_or_read_but_never_crashes(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for _ in range(60):
        low, high = ((0, 44), (4096, 4140), (5120, 7000))[rng.integers(3)]
        path = changed(tmp_path, 2, int(rng.integers(low, high)), rng.bytes(2))
        with suppress(SplatError):
            assert np.isfinite(formats.read(path).means).all()


@pytest.mark.parametrize("level", [0, 1, 2])
def test_an_independent_reader_finds_the_same(level: int) -> None:
    path = FOLDER / f"level_{level}.ksplat"
    splats = formats.read(path)
    proof = Prover.of(splats, cameras_for(splats)).prove(path)
    assert proof.fault == ""
    assert proof.figures["verify_db"] > 80
