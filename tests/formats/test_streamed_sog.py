"""Streamed SOG: levels of detail in chunks, as PlayCanvas lays them out."""

from __future__ import annotations

import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import Family, SplatError
from stages.editing import levels
from stages.evaluate.image_metrics import capped_psnr_db
from stages.formats import sog, streamed_sog
from stages.formats.values import drawable_rows
from stages.proof.checks import read_back
from stages.raster.draw import raster_settings_of, renderer
from stages.scene import Camera, Splats, look_at
from tests.editing.walls import wall
from tests.formats.truth import many_splats


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a few thousand splats have levels, leaves and chunks."""
    monkeypatch.setattr(levels, "_FEWEST", 300)
    monkeypatch.setattr(streamed_sog, "LEAF", 200)
    monkeypatch.setattr(streamed_sog, "CHUNK_SPLATS", 700)


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    levels.write(tmp_path / "a" / "lod-meta.json", many_splats(2000), units="metres")
    return tmp_path / "a" / "lod-meta.json"


def leaves(meta: dict[str, Any]) -> list[dict[str, Any]]:
    found, waiting = [], [meta["tree"]]
    while waiting:
        node = waiting.pop()
        found += [node] if "lods" in node else []
        waiting += node.get("children", [])
    return found


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def test_the_finest_level_comes_back_in_the_declared_order(asset: Path) -> None:
    splats = many_splats(2000)
    found, wanted = formats.read(asset), splats.take(streamed_sog.order(splats))
    assert found.sh_degree == 3
    np.testing.assert_allclose(found.means, wanted.means, atol=0.01)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.003)


def test_an_independent_reader_finds_the_same(asset: Path) -> None:
    first, second = formats.read(asset), read_back(asset).splats
    np.testing.assert_allclose(second.means, first.means, atol=1e-5)
    np.testing.assert_allclose(second.sh, first.sh, atol=1e-6)


def test_every_row_of_every_chunk_belongs_to_one_leaf(asset: Path) -> None:
    meta = json.loads(asset.read_text())
    assert meta["version"] == 1
    assert meta["counts"] == [2000, 500, 125]
    assert (meta["count"], meta["lodLevels"]) == (2625, 3)
    named: dict[int, list[tuple[int, int]]] = {}
    for leaf in leaves(meta):
        for level, at in leaf["lods"].items():
            assert meta["filenames"][at["file"]].startswith(f"{level}_")
            named.setdefault(at["file"], []).append((at["offset"], at["count"]))
    assert len(named) == len(meta["filenames"]) > 4
    for file, ranges in named.items():
        chunk = json.loads((asset.parent / meta["filenames"][file]).read_text())
        ends = np.cumsum([count for _, count in sorted(ranges)])
        assert [offset for offset, _ in sorted(ranges)] == [0, *ends[:-1]]
        assert ends[-1] == chunk["count"]


def test_a_leaf_bounds_what_is_in_it(asset: Path) -> None:
    splats = formats.read(asset)
    meta = json.loads(asset.read_text())
    low, high = (np.array(meta["tree"]["bound"][end]) for end in ("min", "max"))
    assert (splats.means > low).all()
    assert (splats.means < high).all()
    assert all((np.array(leaf["bound"]["min"]) >= low - 1e-9).all() for leaf in leaves(meta))


def test_units_and_origin_are_kept(tmp_path: Path) -> None:
    far = replace(many_splats(50), origin=np.array([1e6, 2.0, 3.0]))
    path = tmp_path / "lod-meta.json"
    levels.write(path, far, units="metres")
    np.testing.assert_array_equal(formats.read(path).origin, far.origin)
    assert formats.units_of(path) == "metres"


def test_what_cannot_be_drawn_is_left_out_and_counted(tmp_path: Path) -> None:
    splats = many_splats(50)
    splats.means[3] = np.nan
    assert drawable_rows(splats).sum() == 49
    assert levels.write(tmp_path / "lod-meta.json", splats) == 1
    assert len(formats.read(tmp_path / "lod-meta.json")) == 49


def test_an_asset_takes_the_place_of_an_earlier_one(asset: Path) -> None:
    (asset.parent / "notes.txt").write_text("mine")
    levels.write(asset, many_splats(100))
    assert len(formats.read(asset)) == 100
    names = {path.name for path in asset.parent.iterdir()}
    assert names == {"lod-meta.json", "lod-meta.html", "0_3", "notes.txt"}
    row = formats.format_of(asset)
    assert row.size_bytes(asset) == sum(p.stat().st_size for p in asset.parent.rglob("*.*")) - 4


def test_an_asset_removes_and_counts_nothing_that_the_earlier_one_does_not_name(
    asset: Path,
) -> None:
    mine = [asset.parent / name for name in ("2024_05/photo.webp", "0_0/photo.webp")]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    levels.write(asset, many_splats(100))
    assert [path.read_text() for path in mine] == ["mine", "mine"]
    assert len(formats.read(asset)) == 100
    assert {path.name for path in asset.parent.iterdir() if path.is_dir()} == {
        "0_0",
        "0_3",
        "2024_05",
    }
    assert mine[0] not in formats.format_of(asset).files(asset)


@pytest.mark.parametrize("earlier", [None, "no JSON", "5", '{"filenames": ["../0_0/meta.json"]}'])
@pytest.mark.parametrize("mine", ["0_0/photo.webp", "0_0/meta.json"])
def test_a_folder_of_the_user_s_is_left_alone(
    tmp_path: Path, earlier: str | None, mine: str
) -> None:
    path = tmp_path / "lod-meta.json"
    (tmp_path / "0_0").mkdir()
    (tmp_path / mine).write_text("mine")
    if earlier is not None:
        path.write_text(earlier)
    levels.write(path, many_splats(100))
    assert (tmp_path / mine).read_text() == "mine"
    assert [file.name for file in (tmp_path / "0_0").iterdir()] == [Path(mine).name]
    assert len(formats.read(path)) == 100


def test_a_page_of_the_user_s_is_refused_before_anything_changes(tmp_path: Path) -> None:
    (tmp_path / "lod-meta.html").write_text("mine")
    with pytest.raises(SplatError) as refused:
        levels.write(tmp_path / "lod-meta.json", many_splats(100))
    assert (refused.value.code, refused.value.family) == ("lod-folder-taken", Family.USAGE)
    assert [file.name for file in tmp_path.iterdir()] == ["lod-meta.html"]
    assert (tmp_path / "lod-meta.html").read_text() == "mine"


@pytest.mark.parametrize("calls", range(7))
def test_a_stop_at_any_rename_or_removal_leaves_one_whole_asset(
    asset: Path, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    left, remove = [calls], streamed_sog._remove_chunk

    def dying(call):
        def changed(*given, **more):
            if call == remove or Path(given[1]).parent == asset.parent:
                left[0] -= 1
                if left[0] < 0:
                    raise KeyboardInterrupt
            return call(*given, **more)

        return changed

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Path, "rename", dying(Path.rename))
        patch.setattr(os, "replace", dying(os.replace))
        patch.setattr(streamed_sog, "_remove_chunk", dying(remove))
        levels.write(asset, many_splats(100))
    assert len(formats.read(asset)) == (2000 if calls < 2 else 100)


def test_no_splats_at_all_are_an_asset_too(tmp_path: Path) -> None:
    levels.write(tmp_path / "lod-meta.json", many_splats(5).take(slice(0)))
    assert len(formats.read(tmp_path / "lod-meta.json")) == 0


def without_finest(meta: dict[str, Any]) -> None:
    for leaf in leaves(meta)[:2]:
        del leaf["lods"]["0"]


def test_other_programs_files_are_read_too(asset: Path) -> None:
    """Without a version, a leaf without its finest level, a chunk as .sog, surroundings."""
    edit(asset, without_finest)
    edit(asset, lambda meta: (meta.pop("version"), meta.pop("asset")))
    coarse = len(formats.read(asset))
    assert 1500 < coarse < 2000
    sog.write(asset.parent / "sky.sog", many_splats(30))
    first = json.loads(asset.read_text())["filenames"][0]
    with zipfile.ZipFile(asset.parent / "first.sog", "w") as package:
        for file in (asset.parent / first).parent.iterdir():
            package.write(file, file.name)
    edit(asset, lambda meta: meta.update(environment="sky.sog"))
    edit(asset, lambda meta: meta["filenames"].__setitem__(0, "first.sog"))
    assert len(formats.read(asset)) == coarse + 30


def lod(meta: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = leaves(meta)[0]["lods"]["0"]
    return found


@pytest.mark.parametrize(
    "change",
    [
        lambda meta: meta.update(version=2),
        lambda meta: meta.pop("tree"),
        lambda meta: meta.update(filenames="0_0"),
        lambda meta: meta["filenames"].__setitem__(0, "../a/0_0/meta.json"),
        lambda meta: meta["filenames"].__setitem__(0, "/etc/passwd"),
        lambda meta: meta["filenames"].__setitem__(0, 7),
        lambda meta: meta["filenames"].__setitem__(0, "9_9/meta.json"),
        lambda meta: lod(meta).update(file=99),
        lambda meta: lod(meta).update(offset=-1),
        lambda meta: lod(meta).update(count=10**9),
        lambda meta: lod(meta).update(count="many"),
        lambda meta: lod(meta).pop("offset"),
        lambda meta: leaves(meta)[0]["lods"].update({"0": 5}),
        lambda meta: leaves(meta)[0]["lods"].update(first={}),
        lambda meta: meta["tree"]["children"].append(meta["tree"]["children"][0]),
        lambda meta: meta["tree"].update(children=[3]),
    ],
)
def test_a_list_of_chunks_that_is_wrong_gets_one_clear_error(
    asset: Path, change: Callable[[dict[str, Any]], Any]
) -> None:
    edit(asset, change)
    with pytest.raises(SplatError) as refused:
        formats.read(asset)
    assert refused.value.code == "splats-unreadable"


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_what_is_no_list_of_chunks_is_refused(asset: Path, content: bytes) -> None:
    asset.write_bytes(content)
    with pytest.raises(SplatError, match="lod-meta"):
        formats.read(asset)


def test_a_chunk_that_is_gone_or_cut_short_is_refused(asset: Path) -> None:
    picture = asset.parent / "0_1" / "quats.webp"
    picture.write_bytes(picture.read_bytes()[:40])
    with pytest.raises(SplatError):
        formats.read(asset)
    shutil.rmtree(picture.parent)
    with pytest.raises(SplatError, match="0_1"):
        formats.read(asset)


def camera_at(distance: float) -> Camera:
    eye = np.array([0.4, -0.3, -0.8]) / np.linalg.norm([0.4, -0.3, -0.8]) * distance
    return Camera(200, 200, 400, 400, 100, 100, look_at(eye, np.zeros(3)))


def at_one_pixel(level: Splats, focal: float = 400.0) -> float:
    """How far away the splats of a level are a pixel wide: two standard deviations."""
    return focal * 2 * float(np.median(np.exp(level.log_scales.max(axis=1))))


def test_a_level_looks_like_the_scene_where_its_splats_are_a_pixel() -> None:
    full = wall(8000)
    every = [full, *levels.coarser_levels(full)]
    assert [len(level) for level in every] == [8000, 2000, 500, 125]
    settings = replace(raster_settings_of(full), antialias=True)
    for level in every[1:]:
        camera = camera_at(at_one_pixel(level))
        picture = renderer(full, settings)(camera).image
        assert picture.max() > 0.3
        found = capped_psnr_db(renderer(level, settings)(camera).image, np.clip(picture, 0, 1))
        assert found > 40, len(level)
        share = len(level) / len(full)
        assert math.log(share, 4) <= -1
