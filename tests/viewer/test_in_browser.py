"""The page in a real browser: upright, not mirrored, the right colours, from the right place."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import formats
from stages.evaluate.image_metrics import psnr
from stages.formats import ply
from stages.viewer.server import LocalServer
from stages.viewer.site import site
from tests.viewer.browser import Browser
from tests.viewer.screenshots import (
    SIZE,
    WORSE_DB,
    coloured_scene,
    drawn,
    views,
    wrong_versions,
)

SAME_DB = 30.0
"""The viewer keeps scales and rotations as 16-bit floats, cuts splats off earlier and blends in 8
bits; on this scene that costs about 35 dB."""

PLACE = """(camera => [camera.getPosition(), camera.forward].map(({ x, y, z }) => [x, y, z]))
    (splatSelection.app.root.findByName("camera"))"""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("served")
    ply.write(folder / "scene.ply", coloured_scene())
    for view in views():
        Image.fromarray(np.uint8(drawn(view) * 255)).save(folder / view.image)
    server = LocalServer(site("test", coloured_scene(), folder / "scene.ply", views(), folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.address
    server.shutdown()
    server.server_close()
    thread.join()


def check_pictures(browser: Browser) -> None:
    for view in views():
        answer = browser.run(f"window.splatShow({view.name!r})")
        assert answer["splats"] == len(coloured_scene())
        picture, ours = browser.picture(), drawn(view)
        right = psnr(picture, ours)
        assert right > SAME_DB, view.name
        for name, wrong in wrong_versions(picture).items():
            assert psnr(wrong, ours) < right - WORSE_DB, (view.name, name)


def test_the_served_page_draws_what_render_draws(browser: Browser, address: str) -> None:
    browser.requests.clear()
    browser.open(address + "?bare&webgl")
    browser.run("window.splatReady")
    check_pictures(browser)
    origin = "/".join(address.split("/")[:3])
    outside = [a for a in browser.requests if not a.startswith((address, f"blob:{origin}/"))]
    assert not outside


def test_a_file_of_its_own_draws_the_same_from_disk(browser: Browser, tmp_path: Path) -> None:
    formats.write(tmp_path / "a b.html", coloured_scene(), views=views())
    browser.requests.clear()
    page = (tmp_path / "a b.html").as_uri()
    browser.open(page + "?bare&webgl&camera=day%201/%3C2%3E.png")
    assert browser.run("window.splatReady")["name"] == "day 1/<2>.png"
    check_pictures(browser)
    assert not [a for a in browser.requests if not a.startswith((page, "blob:", "data:"))]


def test_the_photograph_is_shown_beside_until_the_camera_moves(
    browser: Browser, address: str
) -> None:
    browser.resize((900, 700))
    browser.open(address + "?webgl")
    assert browser.run("window.splatReady")["name"] == "day 1/<0>.png"
    assert "10 splats" in browser.run("document.getElementById('figures').textContent")
    browser.run("document.querySelector('#compare input').click()")
    shown = browser.run(
        "new Promise(done => { const image = document.querySelector('#photo img');"
        "const tell = () => done([image.naturalWidth, image.offsetParent !== null]);"
        "image.complete && image.src ? tell() : image.onload = tell; })"
    )
    assert shown == [SIZE[0], True]
    caption = "document.querySelector('#photo figcaption').textContent"
    assert browser.run(caption) == "day 1/<0>.png: training never saw it"
    browser.run("document.getElementById('next').click()")
    assert browser.run(caption) == "day 1/<1>.png: used in training"
    for kind, x in (("mousePressed", 200), ("mouseMoved", 230), ("mouseReleased", 230)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=380, button="left", clickCount=1)
    note = "document.getElementById('note').textContent"
    assert "Moved" in browser.run(note)
    browser.run("document.getElementById('back').click()")
    assert browser.run(note) == ""
    browser.run("document.querySelector('.sse-flyCamera').click()")
    assert "Moved" in browser.run(note)


@pytest.mark.parametrize("wait_s", [0.0, 0.2, 0.6])
def test_a_touch_soon_after_a_camera_was_chosen_does_not_throw_the_picture_back(
    browser: Browser, address: str, wait_s: float
) -> None:
    """Nor does the viewer's own camera, which takes a while to get there, go on after it."""
    browser.resize((900, 700))
    browser.open(address + "?webgl")
    browser.run("window.splatReady")
    shots = json.loads(browser.run("document.getElementById('scene').textContent"))["shots"]
    shot = next(shot for shot in shots if shot["name"] == views()[2].name)
    browser.run(f"void splatShow({shot['name']!r})")
    time.sleep(wait_s)
    at: dict[str, Any] = {"x": 450, "y": 500, "button": "right", "clickCount": 1}
    browser.call("Input.dispatchMouseEvent", type="mousePressed", **at)
    towards = np.subtract(shot["target"], shot["position"])
    depth = float(np.linalg.norm(towards))
    for _ in range(2):
        browser.run("new Promise(done => splatSelection.app.once('frameend', done))")
        position, forward = np.array(browser.run(PLACE))
        assert np.linalg.norm(position - shot["position"]) < 0.02 * depth
        assert np.degrees(np.arccos(min(1, forward @ towards / depth))) < 1
        browser.call("Input.dispatchMouseEvent", type="mouseReleased", **at)
        browser.run("splatSelection.app.renderNextFrame = true; 0")
    assert "Moved" in browser.run("document.getElementById('note').textContent")


def test_splats_that_cannot_be_loaded_are_reported(browser: Browser, tmp_path: Path) -> None:
    formats.write(tmp_path / "none.html", coloured_scene().take(np.zeros(10, bool)))
    browser.open((tmp_path / "none.html").as_uri())
    browser.run("window.splatReady.catch(() => 0)")
    text = browser.run("document.getElementById('message').textContent")
    assert "not one splat" in text
