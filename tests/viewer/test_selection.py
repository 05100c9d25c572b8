"""Selecting by eye: what the page writes selects on the command line what was seen selected."""

from __future__ import annotations

import base64
import shlex
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from stages.formats import ply
from stages.scene import View
from stages.viewer.server import Item, LocalServer
from stages.viewer.site import site
from tests import scenes
from tests.formats.truth import many_splats
from tests.viewer.browser import Browser
from tests.viewer.screenshots import SIZE

CHAIN = "document.getElementById('chain').value"
CHOSEN = "splatSelection.chosen.map(i => Array.from(splatSelection.centres.subarray(i, i + 3)))"

CAMERA = "Array.from(splatSelection.app.root.findByName('camera').getWorldTransform().data)"


def opened(browser: Browser, folder: Path) -> Path:
    """The page of a file with a name that a shell would take apart."""
    page = folder / "it's a page.html"
    formats.write(page, many_splats(2000))
    browser.resize((900, 700))
    browser.open(page.as_uri() + "?webgl")
    browser.run("window.splatReady")
    browser.run("document.getElementById('select').open = true")
    return page


def lasso(browser: Browser, corners: list[tuple[float, float]]) -> None:
    browser.run(
        "(tool => { tool.value = 'lasso'; tool.onchange(); })(document.getElementById('tool'))"
    )
    for number, (x, y) in enumerate([*corners, corners[-1]]):
        kind = ["mousePressed", *["mouseMoved"] * (len(corners) - 1), "mouseReleased"][number]
        browser.call(
            *("Input.dispatchMouseEvent",),
            type=kind,
            x=x,
            y=y,
            button="left",
            buttons=1,
            clickCount=1,
        )


def selected(browser: Browser) -> np.ndarray:
    """[N, 3] centres, in an order of their own."""
    return in_order(np.array(browser.run(CHOSEN), np.float32).reshape(-1, 3))


def in_order(means: np.ndarray) -> np.ndarray:
    return means[np.lexsort(means.T)]


def edited(browser: Browser, page: Path) -> np.ndarray:
    """[N, 3] centres that what the page wrote leaves."""
    words = shlex.split(browser.run(CHAIN))
    assert words[:4] == ["splat", "edit", page.name, "edited.ply"]
    out = page.with_name("out.ply")
    result = CliRunner().invoke(app, ["edit", str(page), str(out), *words[4:]])
    assert result.exit_code == 0, result.stderr
    return in_order(formats.read(out).means)


@pytest.mark.slow
def test_a_lasso_selects_the_same_on_the_command_line_as_on_the_page(
    browser: Browser, tmp_path: Path
) -> None:
    page = opened(browser, tmp_path)
    hollow = [(420, 200), (650, 220), (700, 500), (560, 300), (430, 520)]
    lasso(browser, [(x + 0.5, y) for x, y in hollow])
    seen = selected(browser)
    assert 50 < len(seen) < 1500
    assert f"{len(seen)} of 2,000 selected" in browser.run(
        "document.getElementById('chosen').textContent"
    )
    picture = browser.picture()
    yellow = (picture[..., 0] > 0.9) & (picture[..., 2] < 0.1)
    assert yellow[200:520, 420:700].sum() > 30
    browser.run("document.getElementById('keep').click()")
    np.testing.assert_array_equal(edited(browser, page), seen)


@pytest.mark.slow
def test_undo_removes_the_last_of_several_selections(browser: Browser, tmp_path: Path) -> None:
    page = opened(browser, tmp_path)
    lasso(browser, [(420, 200), (650, 220), (600, 500)])
    lassoed = selected(browser)
    browser.run("document.getElementById('drop').click()")
    browser.run(
        "(tool => { tool.value = 'box'; tool.onchange(); })(document.getElementById('tool'));"
        "(side => { side.value = '0.125'; side.oninput(); })"
        "(document.querySelector('#box input'))"
    )
    boxed = selected(browser)
    assert 0 < len(boxed) < 2000 - len(lassoed)
    assert (boxed[:, 0] >= 0.12).all()
    browser.run("document.getElementById('keep').click()")
    np.testing.assert_array_equal(edited(browser, page), boxed)
    browser.run("document.getElementById('undo').click()")
    assert len(edited(browser, page)) == 2000 - len(lassoed)


@pytest.mark.slow
def test_what_is_left_out_is_hidden_at_once_undone_and_saved_as_on_the_command_line(
    browser: Browser, tmp_path: Path
) -> None:
    page = opened(browser, tmp_path)
    assert all(disabled(browser, name) for name in ("keep", "drop", "undo", "save", "copy"))
    before = settled(browser)
    lasso(browser, [(420, 200), (650, 220), (700, 500), (560, 560), (430, 520)])
    inside = (slice(300, 450), slice(480, 600))
    browser.run("document.getElementById('drop').click()")
    after = settled(browser)
    assert before[inside].mean() > 2 * after[inside].mean()
    outside = (slice(600, 690), slice(100, 300))
    np.testing.assert_allclose(after[outside], before[outside], atol=1 / 255)
    browser.run(
        "window.saved = new Promise(done => { URL.createObjectURL = blob => {"
        "const reader = new FileReader(); reader.onload = () => done(reader.result.split(',')[1]);"
        "reader.readAsDataURL(blob); return '#'; }; }); document.getElementById('save').click()"
    )
    saved = tmp_path / "saved.ply"
    saved.write_bytes(base64.b64decode(browser.run("window.saved")))
    np.testing.assert_array_equal(in_order(formats.read(saved).means), edited(browser, page))
    browser.run("document.getElementById('undo').click()")
    np.testing.assert_allclose(settled(browser), before, atol=1 / 255)
    assert disabled(browser, "save")


def disabled(browser: Browser, name: str) -> bool:
    return bool(browser.run(f"document.getElementById({name!r}).disabled"))


def settled(browser: Browser) -> np.ndarray:
    """The picture of the scene when nothing changes any more, without the panel."""
    browser.run("document.getElementById('panel').style.visibility = 'hidden'")
    browser.run("new Promise(done => setTimeout(done, 700))")
    picture = browser.picture()
    browser.run("document.getElementById('panel').style.visibility = ''")
    return picture


def test_the_command_is_for_the_shell_of_the_system(browser: Browser, tmp_path: Path) -> None:
    system = "Object.defineProperty(navigator, 'platform', { value: 'Win32' })"
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=system)
    opened(browser, tmp_path)
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert browser.run(CHAIN) == 'splat edit "it\'s a page.html" edited.ply'


def test_looking_around_selects_nothing(browser: Browser, tmp_path: Path) -> None:
    page = opened(browser, tmp_path)
    assert shlex.split(browser.run(CHAIN)) == ["splat", "edit", page.name, "edited.ply"]
    assert "2,000 left" in browser.run("document.getElementById('chosen').textContent")
    assert browser.run("document.getElementById('keep').disabled")
    browser.resize(SIZE)


def click(browser: Browser, x: float, y: float) -> None:
    for kind, buttons in (("mousePressed", 1), ("mouseReleased", 0)):
        where: dict[str, Any] = {"x": x, "y": y, "button": "left", "buttons": buttons}
        browser.call("Input.dispatchMouseEvent", type=kind, clickCount=1, **where)


@pytest.mark.slow
def test_a_click_names_the_place_and_several_make_a_box(browser: Browser, tmp_path: Path) -> None:
    camera = scenes.camera(900, 700, focal=700.0)
    x, y = np.meshgrid(np.arange(-2.5, 2.6, 0.1), np.arange(-2.0, 2.1, 0.1))
    wall = scenes.splats(np.stack([x, y, 4 + 0.1 * x], -1).reshape(-1, 3), 0.1, 0.9)
    scene = scenes.join(wall, scenes.splats([[0, 0, 1.0]], 0.1, 0.1), wall.take(slice(0, 1)))
    ply.write(tmp_path / "scene.ply", scene)
    queries: list[dict[str, str]] = []

    def record(query: dict[str, str]) -> Item:
        queries.append(query)
        return Item(b"", "text/plain")

    items = site("wall", scene, tmp_path / "scene.ply", (View("a.jpg", "", camera),))
    with LocalServer({**items, "/point": record}) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.resize((900, 700))
        browser.open(server.address + "?webgl")
        browser.run("window.splatReady")
        browser.run("document.getElementById('select').open = true")
        browser.run(
            "(tool => { tool.value = 'points'; tool.onchange(); })(document.getElementById('tool'))"
        )
        before = browser.run(CAMERA)
        places = [(0.0, 0.0, 4.0), (1.0, -0.5, 4.1), (0.5, 1.2, 4.05)]
        for place in places:
            (pixel,), _ = camera.project(np.array([place]))
            click(browser, *pixel.tolist())
            browser.run("new Promise(done => setTimeout(done, 1500))")  # a camera would turn
        shown = browser.run("document.getElementById('chosen').textContent")
        turned = browser.run(f"{CAMERA}.map((v, i) => Math.abs(v - {before}[i]))")
        server.shutdown()
    assert max(turned) < 1e-6
    assert shown.startswith("0.5,1.2,4.05: ")
    found = [tuple(map(float, query["at"].split(","))) for query in queries]
    np.testing.assert_allclose(found, places, atol=1e-3)
    assert [query.get("box") for query in queries[:2]] == [None, "0,-0.5,4,1,0,4.1"]
    assert queries[2]["box"] == "0,-0.5,4,1,1.2,4.1"
    assert not browser.run("document.getElementById('keep').disabled")
