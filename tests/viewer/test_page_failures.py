"""A page that cannot show its splats says why, and never "Loading" for ever."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from stages import formats
from stages.formats import ply
from stages.page import document
from stages.viewer.server import Item, LocalServer
from stages.viewer.site import site
from tests.viewer.browser import Browser
from tests.viewer.screenshots import coloured_scene

NO_GRAPHICS = """
HTMLCanvasElement.prototype.getContext = () => null;
Object.defineProperty(navigator, "gpu", { value: undefined });
"""
OTHERS_ERROR = "document.addEventListener('DOMContentLoaded', () => {{ {} }});"
SHOWN = """(message => [message.getAttribute("role"), message.textContent,
    message.checkVisibility(),
    document.getElementById("view").checkVisibility({visibilityProperty: true})])
    (document.getElementById("message"))"""


@contextmanager
def before_scripts(browser: Browser, script: str) -> Iterator[None]:
    """Every page that is opened runs `script` first."""
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    yield
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


@contextmanager
def serving(items: dict[str, Item]) -> Iterator[str]:
    server = LocalServer(items)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.address
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def failure(browser: Browser, address: str) -> str:
    """What a page says that fails, after it was checked that it is seen and read out."""
    browser.open(address)
    browser.run("(window.splatReady || Promise.reject()).catch(() => 0)")
    browser.run("new Promise(done => setTimeout(done, 50))")
    role, text, visible, scene_visible = browser.run(SHOWN)
    assert (role, visible, scene_visible) == ("alert", True, False)
    assert text.startswith("The splats cannot be shown: ")
    return str(text)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    formats.write(tmp_path / "scene.html", coloured_scene())
    return tmp_path / "scene.html"


def test_a_browser_without_graphics_is_told_so(browser: Browser, page: Path) -> None:
    with before_scripts(browser, NO_GRAPHICS):
        assert "neither WebGL 2 nor WebGPU" in failure(browser, page.as_uri())


@pytest.mark.parametrize("cut", [0.3, 0.9, 0.999])
def test_a_page_that_was_cut_off_is_told_so(browser: Browser, page: Path, cut: float) -> None:
    whole = page.read_bytes()
    page.write_bytes(whole[: int(cut * len(whole))])
    text = failure(browser, page.as_uri())
    assert "not complete" in text or "Invalid or unexpected token" in text or "end of input" in text


@pytest.mark.parametrize("error", ["Promise.reject(new Error('x'))", "throw new Error('x')"])
def test_an_early_error_of_another_script_does_not_hide_the_scene(
    browser: Browser, page: Path, error: str
) -> None:
    with before_scripts(browser, OTHERS_ERROR.format(error)):
        browser.open(page.as_uri() + "?webgl")
        browser.run("window.splatReady")
    role, _, visible, scene_visible = browser.run(SHOWN)
    assert (role, visible, scene_visible) == ("status", False, True)
    assert not browser.run("document.body.classList.contains('failed')")
    assert browser.picture().max() > 0.5


def test_damaged_splats_are_told(browser: Browser, page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    at = text.index(document.CHUNK_START) + len(document.CHUNK_START) + 200
    page.write_text(text[:at] + "AAAA" + text[at + 4 :], encoding="utf-8")
    assert "damaged" in failure(browser, page.as_uri())


def served(tmp_path: Path) -> dict[str, Item]:
    ply.write(tmp_path / "scene.ply", coloured_scene())
    return site("test", coloured_scene(), tmp_path / "scene.ply")


def test_a_failed_download_is_told_with_what_to_do(browser: Browser, tmp_path: Path) -> None:
    items: dict[str, Any] = served(tmp_path)
    del items["/scene.ply"]
    with serving(items) as address:
        text = failure(browser, address + "?webgl")
    assert "404" in text
    assert "Load the page again" in text


def test_a_download_that_breaks_off_is_told(browser: Browser, tmp_path: Path) -> None:
    items = served(tmp_path)
    whole = (tmp_path / "scene.ply").read_bytes()
    items["/scene.ply"] = Item(whole[: len(whole) // 2], "application/octet-stream")
    with serving(items) as address:
        assert failure(browser, address + "?webgl")
