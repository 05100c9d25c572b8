"""The page in a real browser: upright, not mirrored, the right colours, from the right place."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages import formats
from stages.formats import ply
from stages.measure.images import psnr
from stages.raster import render
from stages.scene import Camera, Splats, View, look_at
from stages.viewer.server import LocalServer
from stages.viewer.site import site
from tests import scenes
from tests.viewer.browser import Browser, find_chromium

PROGRAM = find_chromium()
SIZE = (320, 240)
SAME_DB = 30.0
"""The viewer keeps scales and rotations as 16-bit floats, cuts splats off earlier and blends in 8
bits; on this scene that costs about 35 dB."""
WORSE_DB = 8.0

pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason="no Chromium on the path, and SPLAT_CHROMIUM names none"
)


def coloured_scene() -> Splats:
    """A different colour towards each side, needles that lean one way, and some that change
    colour with the view: no turn or reflection leaves it as it is."""
    blobs = [
        ((-1.0, 0.0, 0.0), (1.0, 0.1, 0.1)),
        ((1.0, 0.2, 0.0), (0.1, 0.9, 0.1)),
        ((0.1, -0.8, 0.3), (0.1, 0.2, 1.0)),
        ((-0.3, 0.8, -0.2), (1.0, 0.9, 0.1)),
        ((0.2, 0.1, 1.0), (0.9, 0.9, 0.9)),
        ((0.3, 0.3, -0.9), (0.8, 0.1, 0.8)),
    ]
    means = [mean for mean, _ in blobs]
    parts = [
        scenes.splats(means, 0.22, 0.9, [rgb for _, rgb in blobs]),
        scenes.splats(
            [(0.55, -0.5, 0.0), (-0.6, -0.45, 0.2)],
            (0.5, 0.04, 0.1),
            0.95,
            (0.1, 0.8, 0.9),
            (0.93, 0.1, 0.05, 0.35),
        ),
    ]
    shiny = scenes.splats([(-0.7, 0.5, 0.5), (0.7, 0.7, -0.3)], 0.2, 0.9).with_sh_degree(3)
    shiny.sh[:, 1:] = np.random.default_rng(3).normal(0, 0.3, shiny.sh[:, 1:].shape)
    shiny = replace(shiny, sh_degrees=np.full(2, 3, np.uint8))
    parts.append(shiny)
    joined = scenes.join(*parts)
    return replace(joined, sh_degrees=np.full(len(joined), 3, np.uint8))


def views() -> tuple[View, ...]:
    """Seen from all around, each camera rolled and with its principal point off centre."""
    made = []
    for i, angle in enumerate(np.radians([20, 140, 260, 300])):
        eye = np.array([3.2 * np.cos(angle), -1.2 + 0.6 * i, 3.2 * np.sin(angle)])
        matrix = look_at(eye, np.array([0.1, 0.0, 0.0]), np.array([0.25, -1.0, 0.1]))
        camera = Camera(*SIZE, 300.0, 300.0, 150.0 + 8 * i, 128.0, matrix)
        made.append(View(f"day 1/<{i}>.png", f"{i}.png", camera))
    return tuple(made)


def drawn(view: View) -> np.ndarray:
    """What `splat render` writes for a view: colours brighter than white are white."""
    return np.clip(render(coloured_scene(), view.camera).image, 0, 1)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    assert PROGRAM is not None
    opened = Browser(PROGRAM, tmp_path_factory.mktemp("profile"), SIZE)
    yield opened
    opened.close()


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


def turned(picture: np.ndarray, degrees: float) -> np.ndarray:
    image = Image.fromarray(np.uint8(picture * 255)).rotate(degrees, Image.Resampling.BILINEAR)
    return np.asarray(image, np.float32) / 255


def wrong_versions(picture: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "mirrored": picture[:, ::-1],
        "upside down": picture[::-1],
        "turned by 180 degrees": picture[::-1, ::-1],
        "tilted by 10 degrees": turned(picture, 10),
        "tilted by -10 degrees": turned(picture, -10),
        "red and blue swapped": picture[..., ::-1],
        "beside its place": np.roll(picture, 8, axis=1),
        "too bright": picture ** (1 / 2.2),
    }


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
    outside = [a for a in browser.requests if not a.startswith((address, "blob:" + address[:-1]))]
    assert not outside


def test_a_file_of_its_own_draws_the_same_from_disk(browser: Browser, tmp_path: Path) -> None:
    formats.write(tmp_path / "a b.html", coloured_scene(), views=views())
    browser.requests.clear()
    page = (tmp_path / "a b.html").as_uri()
    browser.open(page + "?bare&webgl&camera=day%201/%3C2%3E.png")
    assert browser.run("window.splatReady")["name"] == "day 1/<2>.png"
    check_pictures(browser)
    assert not [a for a in browser.requests if not a.startswith((page, "blob:", "data:"))]


def test_the_photograph_stands_beside_and_moving_lets_go(browser: Browser, address: str) -> None:
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
    for kind, x in (("mousePressed", 90), ("mouseMoved", 120), ("mouseReleased", 120)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=150, button="left", clickCount=1)
    note = "document.getElementById('note').textContent"
    assert "Moved" in browser.run(note)
    browser.run("document.getElementById('back').click()")
    assert browser.run(note) == ""
    browser.run("document.querySelector('.sse-flyCamera').click()")
    assert "Moved" in browser.run(note)


def test_splats_that_cannot_be_loaded_are_said_to_be(browser: Browser, tmp_path: Path) -> None:
    formats.write(tmp_path / "none.html", coloured_scene().take(np.zeros(10, bool)))
    browser.open((tmp_path / "none.html").as_uri())
    browser.run("window.splatReady.catch(() => 0)")
    text = browser.run("document.getElementById('message').textContent")
    assert "not one splat" in text
