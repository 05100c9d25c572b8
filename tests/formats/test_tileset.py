"""3D Tiles: levels of detail as tiles that replace one another, placed on the earth."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.editing import levels
from stages.formats import tileset
from stages.proof.checks import read_back
from stages.proof.independent_readers import gltf
from stages.proof.losses import losses_of
from stages.proof.prover import Prover, cameras_for
from stages.scene import Splats
from stages.scene.place import EAST_DOWN_NORTH, GEOGRAPHIC, EarthPlace, geodetic
from tests import scenes
from tests.formats.files import glb_parts
from tests.formats.truth import covariance, many_splats

MUNICH = EarthPlace(GEOGRAPHIC, np.array([48.1, 11.5, 520.0]), EAST_DOWN_NORTH * 2.0)
MUNICH_UTM = EarthPlace("EPSG:25832", np.array([691607.0, 5334760.0, 520.0]), EAST_DOWN_NORTH * 2.0)
# A plane follows the grid over a few metres to less than this; its height is that of the ellipsoid.
MILLIMETRE = 1e-3


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a few thousand splats have levels and tiles."""
    monkeypatch.setattr(levels, "_FEWEST", 300)
    monkeypatch.setattr(tileset, "TILE_SPLATS", 300)


def splats_at(place: EarthPlace | None, count: int = 2000) -> Splats:
    return replace(many_splats(count), origin=np.zeros(3), place=place)


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    levels.write(tmp_path / "a" / "tileset.json", splats_at(None), units="metres")
    return tmp_path / "a" / "tileset.json"


def tiles(tile: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield tile
    for child in tile.get("children", ()):
        yield from tiles(child)


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def ends(tile: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    box = np.array(tile["boundingVolume"]["box"])
    return box[:3] - np.diag(box[3:].reshape(3, 3)), box[:3] + np.diag(box[3:].reshape(3, 3))


def test_the_finest_level_comes_back_in_the_declared_order(asset: Path) -> None:
    found, wanted = formats.read(asset), splats_at(None).take(tileset.order(splats_at(None)))
    assert found.sh_degree == 3
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    second = read_back(asset).splats
    np.testing.assert_allclose(second.means, found.means * [1, -1, -1], atol=1e-6)
    assert formats.units_of(asset) == "metres"


@pytest.mark.parametrize("count", [1, 2, 2000])
def test_it_is_proven_as_any_file_is(tmp_path: Path, count: int) -> None:
    splats = splats_at(None).take(slice(count))
    levels.write(tmp_path / "tileset.json", splats)
    proof = Prover.of(splats, cameras_for(splats)).prove(tmp_path / "tileset.json")
    assert proof.fault == ""
    assert proof.splats == count


def test_splats_at_the_ends_of_32_bits_are_an_asset_too(tmp_path: Path) -> None:
    means = np.array([[-3e38, 0, 0], [0, 0, 0], [3e38, 0, 0]])
    formats.write(tmp_path / "tileset.json", scenes.splats(means, 0.1, 0.9, [(1.0, 0.0, 0.0)] * 3))
    tree = json.loads((tmp_path / "tileset.json").read_text())
    assert 6e38 < tree["geometricError"] < np.inf


def test_no_splats_at_all_are_an_asset_too(tmp_path: Path) -> None:
    levels.write(tmp_path / "tileset.json", splats_at(None).take(slice(0)))
    assert len(formats.read(tmp_path / "tileset.json")) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["tileset.json"]


def test_tiles_hold_levels_and_replace_one_another(asset: Path) -> None:
    meta = json.loads(asset.read_text())
    assert (meta["asset"]["version"], meta["root"]["refine"]) == ("1.1", "REPLACE")
    required = meta["extensions"]["3DTILES_content_gltf"]["extensionsRequired"]
    counts = {0: 0, 1: 0, 2: 0}
    for tile in tiles(meta["root"]):
        document, _ = glb_parts(asset.parent / tile["content"]["uri"])
        assert document["extensionsRequired"] == required
        positions = document["accessors"][0]
        depth = 2 - int(Path(tile["content"]["uri"]).name[0])
        counts[depth] += positions["count"]
        (low, high), children = ends(tile), tile.get("children", [])
        x, y, z = np.array([positions["min"], positions["max"]]).T
        inside = np.stack([x, -z, y])  # a viewer turns glTF's y up to z up
        assert (inside.min(axis=1) >= low - 1e-4).all()
        assert (inside.max(axis=1) <= high + 1e-4).all()
        assert all((ends(child)[0] >= low - 1e-9).all() for child in children)
        assert all(child["geometricError"] < tile["geometricError"] for child in children)
        assert children or tile["geometricError"] == 0
    assert counts == {0: 125, 1: 500, 2: 2000}
    assert meta["geometricError"] > meta["root"]["geometricError"]


def drawn_ends(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] low and high of the splats of a tile, z up, each to where its alpha is 1/255."""
    splats = gltf(path)
    covariances = [
        covariance(q, np.exp(s))
        for q, s in zip(splats.quaternions, splats.log_scales.astype(np.float64), strict=True)
    ]
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    reach = deviations * np.sqrt(2 * np.log(np.maximum(255 * splats.opacities, 1)))[:, None]
    reach, (x, y, z) = reach[:, [0, 2, 1]], splats.means.T
    middle = np.stack([x, -z, y], axis=1)
    return middle - reach, middle + reach


def test_boxes_hold_their_splats_to_where_they_are_not_drawn(tmp_path: Path) -> None:
    splats = splats_at(None)
    splats.log_scales[7] = np.log([3.0, 0.1, 0.1])
    splats.quaternions[7] = np.array([0.5, -1.0, 0.3, 2.0])
    splats.opacity_logits[7] = 8.0
    path = tmp_path / "tileset.json"
    levels.write(path, splats)

    def check(tile: dict[str, Any], above: list[tuple[np.ndarray, np.ndarray]]) -> None:
        boxes = [*above, ends(tile)]
        low, high = drawn_ends(path.parent / tile["content"]["uri"])
        for box in boxes:
            assert (low >= box[0] - 1e-4).all()
            assert (high <= box[1] + 1e-4).all()
        if not tile.get("children"):  # and not much more
            np.testing.assert_allclose([low.min(axis=0), high.max(axis=0)], boxes[-1], atol=1e-4)
        for child in tile.get("children", ()):
            check(child, boxes)

    check(json.loads(path.read_text())["root"], [])


def test_without_levels_the_inner_tiles_hold_nothing(tmp_path: Path) -> None:
    formats.write(tmp_path / "tileset.json", splats_at(None))
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    assert all(("content" in tile) != ("children" in tile) for tile in tiles(root))
    assert len(formats.read(tmp_path / "tileset.json")) == 2000


def geocentric_of(path: Path, means: np.ndarray) -> np.ndarray:
    """[N, 3] where a viewer puts positions of our world."""
    meta = json.loads(path.read_text())
    matrix = np.array(meta["root"]["transform"]).reshape(4, 4).T
    right, up, back = means[:, 0], -means[:, 1], -means[:, 2]  # as in .glb
    return np.stack([right, -back, up], axis=1) @ matrix[:3, :3].T + matrix[:3, 3]


def test_a_tileset_lies_where_its_place_is(tmp_path: Path) -> None:
    origin = np.array([30.0, -1.0, 2.0])
    splats = replace(splats_at(MUNICH, 40), origin=origin)
    path = tmp_path / "tileset.json"
    formats.write(path, splats)
    at = geodetic(geocentric_of(path, np.zeros((1, 3)) - origin))[0]
    np.testing.assert_allclose(at, MUNICH.offset, atol=1e-7)
    east, north, up = geocentric_of(path, np.array([[1, 0, 0], [0, 0, 1], [0, -1.0, 0]]) - origin)
    zero = geocentric_of(path, np.zeros((1, 3)) - origin)[0]
    for step, direction in ((east, [0, 2]), (north, [1, 2]), (up, [2, 2])):
        assert np.linalg.norm(step - zero) == pytest.approx(direction[1])
    assert geodetic(up)[2] == pytest.approx(522.0)
    assert geodetic(north)[0] > 48.1
    assert geodetic(east)[1] > 11.5
    back = formats.read(path)
    np.testing.assert_array_equal(back.origin, origin)
    assert back.place is not None
    np.testing.assert_allclose(back.place.offset, MUNICH.offset)


def test_a_place_in_a_grid_is_followed_to_a_millimetre(tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    splats = splats_at(MUNICH_UTM, 40)
    formats.write(tmp_path / "tileset.json", splats)
    x, y, z = (MUNICH_UTM.offset + splats.means.astype(np.float64) @ MUNICH_UTM.axes.T).T
    longitude, latitude, height = pyproj.Transformer.from_crs(
        MUNICH_UTM.crs, GEOGRAPHIC, always_xy=True
    ).transform(x, y, z)
    wanted = pyproj.Transformer.from_crs(GEOGRAPHIC, "EPSG:4978", always_xy=True).transform(
        longitude, latitude, height
    )
    found = geocentric_of(tmp_path / "tileset.json", splats.means)
    np.testing.assert_allclose(found, np.stack(wanted, axis=1), atol=MILLIMETRE)


def test_a_grid_needs_pyproj(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(SplatError) as refused:
        formats.write(tmp_path / "tileset.json", splats_at(MUNICH_UTM, 5))
    assert refused.value.code == "tiles-need-pyproj"
    assert list(tmp_path.iterdir()) == []


def test_outside_the_grid_there_is_no_tileset(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    nowhere = replace(MUNICH_UTM, offset=np.array([9e8, 9e8, 0.0]))
    with pytest.raises(SplatError) as refused:
        formats.write(tmp_path / "tileset.json", splats_at(nowhere, 5))
    assert refused.value.code == "tiles-elsewhere"


def test_without_a_place_it_is_local_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "tileset.json"
    for place, wanted in ((None, True), (MUNICH, False)):
        splats = splats_at(place, 40)
        formats.write(path, splats)
        assert ("transform" in json.loads(path.read_text())["root"]) != wanted
        proof = Prover.of(splats, cameras_for(splats)).prove(path)
        assert ("place" in losses_of(path, splats, proof)) == wanted


def test_an_asset_takes_the_place_of_an_earlier_one(asset: Path) -> None:
    mine = [asset.parent / name for name in ("notes.txt", "tiles_0/photo.glb", "tiles_7/0_0.glb")]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    levels.write(asset, splats_at(None, 100))
    assert [path.read_text() for path in mine] == ["mine"] * 3
    assert len(formats.read(asset)) == 100
    assert {path.name for path in asset.parent.iterdir()} == {
        *("notes.txt", "tileset.json", "tiles_0", "tiles_1", "tiles_7")
    }
    assert [path.name for path in (asset.parent / "tiles_0").iterdir()] == ["photo.glb"]
    assert formats.format_of(asset).files(asset) == [asset, asset.parent / "tiles_1" / "0_0.glb"]


@pytest.mark.parametrize("calls", range(4))
def test_a_stop_at_any_rename_leaves_one_whole_asset(
    asset: Path, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    left = [calls]

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def changed(*given: Any, **more: Any) -> Any:
            if Path(given[1]).parent == asset.parent:
                left[0] -= 1
                if left[0] < 0:
                    raise KeyboardInterrupt
            return call(*given, **more)

        return changed

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Path, "rename", dying(Path.rename))
        patch.setattr(os, "replace", dying(os.replace))
        levels.write(asset, splats_at(None, 100))
    assert len(formats.read(asset)) == (2000 if calls < 2 else 100)


def _adds(meta: dict[str, Any]) -> None:
    meta["root"]["refine"] = "ADD"


def test_tiles_that_add_to_their_parents_are_read_with_them(asset: Path) -> None:
    edit(asset, _adds)
    edit(asset, lambda meta: meta.pop("extensions"))
    assert len(formats.read(asset)) == len(read_back(asset).splats) == 125 + 500 + 2000


def first_tile(meta: dict[str, Any]) -> dict[str, Any]:
    return next(tile for tile in tiles(meta["root"]) if "children" not in tile)


@pytest.mark.parametrize(
    "change",
    [
        lambda meta: meta.pop("root"),
        lambda meta: meta.pop("asset"),
        lambda meta: meta["root"].update(children=7),
        lambda meta: meta["root"].update(implicitTiling={}),
        lambda meta: meta["root"]["children"].append(None),
        lambda meta: first_tile(meta).update(content=5),
        lambda meta: first_tile(meta)["content"].update(uri="more/tileset.json"),
        lambda meta: first_tile(meta)["content"].update(uri="../a/tiles_0/2_0.glb"),
        lambda meta: first_tile(meta)["content"].update(uri="http://example.com/a.glb"),
        lambda meta: first_tile(meta)["content"].update(uri="tiles_0/9_9.glb"),
        lambda meta: first_tile(meta).update(transform=[2.0, *np.eye(4).ravel().tolist()[1:]]),
        lambda meta: first_tile(meta).update(transform="x"),
        lambda meta: meta["asset"].update(extras={"splat_origin": [1, 2]}),
    ],
)
def test_a_tileset_that_is_wrong_gets_one_clear_error(
    asset: Path, change: Callable[[dict[str, Any]], Any]
) -> None:
    edit(asset, change)
    with pytest.raises(SplatError) as refused:
        formats.read(asset)
    assert refused.value.code == "splats-unreadable"


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_what_is_no_tileset_is_refused(asset: Path, content: bytes) -> None:
    asset.write_bytes(content)
    with pytest.raises(SplatError, match="tileset"):
        formats.read(asset)


def test_a_tile_that_is_cut_short_is_refused(asset: Path) -> None:
    tile = asset.parent / first_tile(json.loads(asset.read_text()))["content"]["uri"]
    tile.write_bytes(tile.read_bytes()[:-40])
    with pytest.raises(SplatError, match="cut short"):
        formats.read(asset)


def test_the_same_tile_many_times_is_refused(asset: Path) -> None:
    def shared(meta: dict[str, Any]) -> None:
        meta["root"]["children"] = [first_tile(meta)] * 3

    edit(asset, shared)
    with pytest.raises(SplatError, match="twice"):
        formats.read(asset)
