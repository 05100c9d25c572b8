"""Positions in a survey's coordinates: metres far from zero, told to less than a millimetre."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.formats import usd_read
from stages.formats.ply import property_names
from stages.scene.recentring import recentred
from tests.formats.files import edited_glb, ply_bytes
from tests.formats.truth import many_splats, red_splat

UTM = np.array([431_234.567, 5_412_345.678, 312.25])
MILLIMETRE = 1e-3  # a float32 at 5.4 million is good to a quarter of a metre


def survey_ply(path: Path, encoding: str = "binary_little_endian") -> np.ndarray:
    """Write splats around UTM as doubles; their true centres."""
    splats = many_splats(50)
    exact = splats.means.astype(np.float64) + UTM
    names = property_names(3)
    data = ply_bytes(splats, names, encoding, "double")
    if encoding == "ascii":
        lines = data.split(b"\n")
        first = next(i for i, x in enumerate(lines) if x == b"end_header") + 3
        for i, centre in enumerate(exact):
            rest = lines[first + i].split()[3:]
            lines[first + i] = b" ".join([*(repr(float(v)).encode() for v in centre), *rest])
        path.write_bytes(b"\n".join(lines))
        return exact
    start = len(data) - 50 * 8 * len(names)
    table = np.frombuffer(data, "<f8", offset=start).reshape(50, -1).copy()
    table[:, :3] = exact
    path.write_bytes(data[:start] + table.tobytes())
    return exact


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
def test_doubles_far_from_zero_keep_their_precision(tmp_path: Path, encoding: str) -> None:
    exact = survey_ply(tmp_path / "a.ply", encoding)
    back = formats.read(tmp_path / "a.ply")
    assert back.means.dtype == np.float32
    np.testing.assert_allclose(back.means + back.origin, exact, atol=MILLIMETRE)


@pytest.mark.parametrize("suffix", ["ply", "compressed.ply", "sog", "html", "usdc", "glb"])
def test_where_a_survey_lies_survives_the_formats_that_hold_it(tmp_path: Path, suffix: str) -> None:
    survey_ply(tmp_path / "a.ply")
    splats = formats.read(tmp_path / "a.ply")
    formats.write(tmp_path / f"b.{suffix}", splats)
    path = tmp_path / f"b.{suffix}"
    back = usd_read.parse(path) if suffix == "usdc" else formats.read(path)
    np.testing.assert_array_equal(back.origin, splats.origin)
    assert np.abs(back.means).max() < 100


@pytest.mark.parametrize(("suffix", "axes"), [("splat", [1, 1, 1]), ("spz", [1, -1, -1])])
def test_where_a_survey_lies_is_written_beside_formats_that_do_not_hold_it(
    tmp_path: Path, suffix: str, axes: list[int]
) -> None:
    survey_ply(tmp_path / "a.ply")
    splats = formats.read(tmp_path / "a.ply")
    path, beside = tmp_path / f"b.{suffix}", tmp_path / f"b.{suffix}.offset.json"
    formats.write(path, splats, units="metres")
    found = json.loads(beside.read_text())
    assert (found["file"], found["units"]) == (path.name, "metres")
    np.testing.assert_array_equal(found["offset"], splats.origin * axes)
    formats.write(path, replace(splats, origin=np.zeros(3)))
    assert not beside.exists()


@pytest.mark.parametrize("name", list(formats.BY_ENDING))
def test_the_table_says_which_formats_hold_the_origin(tmp_path: Path, name: str) -> None:
    row = formats.BY_ENDING[name]
    splats = replace(many_splats(30), origin=UTM)
    path = tmp_path / row.file_name("a")
    formats.write(path, splats)
    back = usd_read.parse(path) if name.startswith("usd") else formats.read(path)
    assert row.holds_origin == bool(back.origin.any())


def test_what_lies_near_zero_is_left_where_it_is() -> None:
    means = many_splats(50).means.astype(np.float64) + np.array([900, -20, 3])
    near, origin = recentred(means, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(near, means.astype(np.float32))
    np.testing.assert_array_equal(origin, [1, 2, 3])


def test_one_splat_far_away_does_not_move_the_others() -> None:
    means = many_splats(50).means.astype(np.float64)
    means[7] = (4e6, 0, 0)
    near, origin = recentred(means, np.zeros(3))
    np.testing.assert_array_equal(near, means.astype(np.float32))
    assert not origin.any()


def test_damaged_positions_do_not_spoil_the_rest() -> None:
    means = many_splats(50).means.astype(np.float64) + UTM
    means[3] = np.nan
    near, origin = recentred(means, np.zeros(3))
    good = np.arange(50) != 3
    np.testing.assert_allclose((near + origin)[good], means[good], atol=MILLIMETRE)
    assert recentred(np.zeros((0, 3)), np.zeros(3))[0].shape == (0, 3)


def test_a_usd_prim_may_be_placed_in_a_survey(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, red_splat())
    moved = (
        "\n        double3 xformOp:translate = (431234.567, 5412345.678, 312.25)\n"
        '        uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    )
    text = path.read_text()
    start = 'def Xform "Scene"\n{'
    assert start in text
    path.write_text(text.replace(start, start + moved))
    back = usd_read.parse(path)
    # the splat at (1, 2, 3) is (1, -2, -3) upright; placed there, and turned back
    wanted = (np.array([1, -2, -3]) + UTM) * [1, -1, -1]
    np.testing.assert_allclose((back.means + back.origin)[0], wanted, atol=MILLIMETRE)


def test_a_gltf_node_may_be_placed_in_a_survey(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    formats.write(path, red_splat())
    edited_glb(path, lambda document: document["nodes"][0].update(translation=list(UTM)))
    back = formats.read(path)
    wanted = (np.array([1, -2, -3]) + UTM) * [1, -1, -1]
    np.testing.assert_allclose((back.means + back.origin)[0], wanted, atol=MILLIMETRE)
