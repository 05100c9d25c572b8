"""Positions in a survey's coordinates: metres far from zero, told to less than a millimetre."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.formats import usd_read
from stages.formats.offset import offset_path
from stages.formats.ply import property_names
from stages.scene.place import EAST_DOWN_NORTH, GEOGRAPHIC, EarthPlace
from stages.scene.recentring import recentred
from tests.formats.files import edited_glb, ply_bytes
from tests.formats.truth import many_splats, red_splat

WRITTEN = [name for name, row in formats.BY_ENDING.items() if row.written]
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


@pytest.mark.parametrize("name", WRITTEN)
def test_the_table_says_which_formats_hold_the_origin(tmp_path: Path, name: str) -> None:
    row = formats.BY_ENDING[name]
    splats = replace(many_splats(30), origin=UTM)
    path = tmp_path / row.file_name("a")
    formats.write(path, splats)
    beside = offset_path(path)
    assert row.holds_origin != beside.exists()
    beside.unlink(missing_ok=True)
    back = usd_read.parse(path) if name.startswith("usd") else formats.read(path)
    assert row.holds_origin == bool(back.origin.any())


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("crs", [GEOGRAPHIC, "EPSG:25832"])
def test_the_place_on_the_earth_survives_every_format(tmp_path: Path, name: str, crs: str) -> None:
    """With what lies beside the file; and the file says it of its own positions and axes."""
    if formats.BY_ENDING[name].on_globe and crs != GEOGRAPHIC:
        pytest.importorskip("pyproj")  # `test_tileset` has what is said without it
    offset = np.array([47.3769, 8.5417, 408.5] if crs == GEOGRAPHIC else UTM)
    place = EarthPlace(crs, offset, EAST_DOWN_NORTH)
    splats = replace(many_splats(30), origin=np.array([1000.0, -20.0, 300.0]), place=place)
    path = tmp_path / formats.BY_ENDING[name].file_name("a")
    formats.write(path, splats, units="metres")
    back = usd_read.parse(path) if name.startswith("usd") else formats.read(path)
    assert back.place is not None
    assert back.place.crs == crs
    np.testing.assert_allclose(back.place.offset, offset, atol=1e-9)
    np.testing.assert_allclose(back.place.axes, EAST_DOWN_NORTH, atol=1e-9)
    np.testing.assert_array_equal(back.origin, splats.origin)


def test_a_file_states_the_place_of_its_own_positions(tmp_path: Path) -> None:
    """By hand: 7 m right, 2 m down and 30 m ahead of the world's zero point; glTF is y up."""
    place = EarthPlace("EPSG:25832", UTM, EAST_DOWN_NORTH)
    splats = replace(many_splats(5), origin=np.array([7.0, 2.0, 30.0]), place=place)
    formats.write(tmp_path / "a.gltf", splats, units="metres")
    said = json.loads((tmp_path / "a.gltf").read_text())["asset"]["extras"]["splat_place"]
    np.testing.assert_allclose(said["offset"], np.add(UTM, [7.0, 30.0, -2.0]), atol=1e-9)
    assert said["axes"] == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    formats.write(tmp_path / "a.spz", splats, units="metres")
    beside = json.loads((tmp_path / "a.spz.offset.json").read_text())
    assert beside["splat_place"] == said


@pytest.mark.parametrize(
    "damage",
    [
        {"crs": "nowhere"}, {"offset": [1, 2]}, {"offset": [1, 2, "x"]}, {"offset": [1, 2, 1e300]},
        {"axes": [[0, 0, 0]] * 3}, {"axes": None}, {"axes": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
    ],
)  # fmt: skip
def test_a_damaged_place_is_an_error(tmp_path: Path, damage: dict[str, Any]) -> None:
    place = EarthPlace("EPSG:25832", UTM, EAST_DOWN_NORTH)
    formats.write(tmp_path / "a.gltf", replace(many_splats(5), place=place))
    data = json.loads((tmp_path / "a.gltf").read_text())
    data["asset"]["extras"]["splat_place"] |= damage
    (tmp_path / "a.gltf").write_text(json.dumps(data))
    with pytest.raises(SplatError) as raised:
        formats.read(tmp_path / "a.gltf")
    assert raised.value.code == "splats-unreadable"


@pytest.mark.parametrize("content", ["[]", "5", '{"offset": {}}'])
def test_a_damaged_offset_is_an_error(tmp_path: Path, content: str) -> None:
    formats.write(tmp_path / "a.spz", replace(many_splats(5), origin=UTM))
    (tmp_path / "a.spz.offset.json").write_text(content)
    with pytest.raises(SplatError) as raised:
        formats.read(tmp_path / "a.spz")
    assert raised.value.code == "splats-unreadable"


@pytest.mark.parametrize("name", WRITTEN)
def test_metres_survive_every_format_that_can_say_so(tmp_path: Path, name: str) -> None:
    row = formats.BY_ENDING[name]
    path = tmp_path / row.file_name("a")
    far = replace(many_splats(30), origin=UTM)
    for units in ("metres", "arbitrary"):
        formats.write(path, far, units=units)
        assert formats.units_of(path) == units
    formats.write(path, replace(far, origin=np.zeros(3)), units="metres")
    assert (formats.units_of(path) == "metres") == row.holds_origin


def test_what_lies_near_zero_is_left_where_it_is() -> None:
    means = many_splats(50).means.astype(np.float64) + np.array([900, -20, 3])
    near, origin = recentred(means, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(near, means.astype(np.float32))
    np.testing.assert_array_equal(origin, [1, 2, 3])


def test_what_32_bits_hold_as_it_is_is_left_where_it_is() -> None:
    means = (many_splats(50).means + np.float32(70_000)).astype(np.float64)
    near, origin = recentred(means, np.zeros(3))
    np.testing.assert_array_equal(near, means)
    assert not origin.any()
    assert recentred(means + 0.1, np.zeros(3))[1].all()


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
