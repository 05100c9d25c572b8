"""An asset that streams, in a real browser: what is far away is drawn from coarser levels."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.editing import levels
from stages.evaluate.image_metrics import psnr
from stages.formats import streamed_sog
from stages.raster.draw import render
from stages.scene import Camera, View, look_at
from stages.viewer.server import Item, LocalServer
from stages.viewer.site import site
from tests.editing.walls import wall
from tests.formats.truth import many_splats
from tests.viewer.browser import Browser
from tests.viewer.screenshots import SIZE

FOCAL = 300.0
SPLATS = 8000
SAME_DB = 30.0
"""As much as the page comes near `splat render` on splats that are not packed, too."""


def views(widths: list[float]) -> tuple[View, ...]:
    """From where the splats of each level are a pixel wide, and a little farther."""
    found = []
    for number, width in enumerate(widths):
        eye = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])
        matrix = look_at(1.5 * FOCAL * width * eye, np.zeros(3))
        camera = Camera(*SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, matrix)
        found.append(View(str(number), "", camera))
    return tuple(found)


@pytest.fixture
def asset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With levels, leaves and chunks of few splats."""
    monkeypatch.setattr(levels, "_FEWEST", 600)
    monkeypatch.setattr(streamed_sog, "LEAF", 1000)
    monkeypatch.setattr(streamed_sog, "CHUNK_SPLATS", 3000)
    levels.write(tmp_path / "a" / "lod-meta.json", wall(SPLATS))
    return tmp_path / "a" / "lod-meta.json"


@pytest.fixture
def address(asset: Path) -> Iterator[str]:
    """Of a page that `splat view` serves; beside it the asset's own page, as any server would."""
    splats = formats.read(asset)
    seen = views(streamed_sog.splat_widths(asset, splats))
    page = asset.with_suffix(".html")
    own = {f"/{page.name}": Item(page, "text/html; charset=utf-8")}
    server = LocalServer(site("test", splats, asset, seen) | own)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.address
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.slow
def test_three_distances_are_drawn_from_three_levels(
    browser: Browser, address: str, asset: Path
) -> None:
    splats = formats.read(asset)
    widths = streamed_sog.splat_widths(asset, splats)
    assert len(widths) == 3
    browser.open(address + "?bare&webgl&camera=2")
    browser.run("window.splatReady")
    assert fetched(browser) == {"2"}
    drawn = []
    for view in reversed(views(widths)):
        drawn.append(browser.run(f"window.splatShow({view.name!r})")["splats"])
        ours = np.clip(render(splats, view.camera).image, 0, 1)
        assert psnr(browser.picture(), ours) > SAME_DB, view.name
    assert drawn[0] == 500
    assert 500 < drawn[1] <= 2000
    assert drawn[2] == SPLATS
    assert fetched(browser) == {"0", "1", "2"}
    browser.run("window.splatShow('2')")
    assert browser.run("splatLevels.budget") == 500


def test_the_asset_s_own_page_shows_it_wherever_it_is_served(
    browser: Browser, address: str, asset: Path
) -> None:
    browser.open(address + "lod-meta.html?bare&webgl")
    shown = browser.run("window.splatReady")
    assert (shown["name"], shown["splats"]) == ("first view", SPLATS)
    assert browser.picture().max() > 0.5
    assert asset.with_suffix(".html") in formats.format_of(asset).files(asset)


def test_a_partly_loaded_streamed_asset_can_be_selected_from(
    browser: Browser, address: str, asset: Path
) -> None:
    browser.open(address + "?webgl&camera=2")
    browser.run("window.splatReady")
    browser.run("splatSelection.corners = [[0, 0], [9, 0], [9, 9]]; splatSelection.end()")
    browser.run("document.getElementById('keep').click()")
    chain = browser.run("document.getElementById('chain').value")
    assert chain.startswith(f'splat edit {asset} edited.ply --crop "lasso:')
    assert browser.run("document.getElementById('chosen').textContent") == ""


def fetched(browser: Browser) -> set[str]:
    """Levels of which a chunk was asked for."""
    names = (address.split("/")[-2] for address in browser.requests if "meta.json" in address)
    return {name[0] for name in names if re.fullmatch(r"[0-9]+_[0-9]+", name)}


@pytest.mark.parametrize("name", ["../a/0_0/meta.json", "/etc/passwd", 7, "9_9/meta.json"])
def test_nothing_beside_the_asset_is_served(asset: Path, name: object) -> None:
    (asset.parent / "notes.txt").write_text("mine")
    served = site("a", many_splats(3), asset)
    assert "/notes.txt" not in served
    assert {"/lod-meta.json", "/0_0/meta.json", "/2_0/means_l.webp"} < set(served)
    meta = json.loads(asset.read_text())
    asset.write_text(json.dumps({**meta, "filenames": [*meta["filenames"], name]}))
    with pytest.raises(SplatError) as refused:
        site("a", many_splats(3), asset)
    assert refused.value.code == "splats-unreadable"
