"""The page on a phone, by the keyboard alone, read out, and for a client."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from stages.formats import ply
from tests.viewer.browser import Browser
from tests.viewer.screenshots import coloured_scene, views

FINGER_PX = 44
PHONE = (390, 844)
BOXES = """JSON.stringify([...document.querySelectorAll("button, select, summary, #compare")]
    .filter(one => one.checkVisibility({visibilityProperty: true, opacityProperty: true}))
    .map(one => [one.id || one.className || one.textContent, one.getBoundingClientRect()]))"""
BOX = "JSON.stringify(document.querySelector({!r}).getBoundingClientRect())"
FOCUSED = """(one => one.id || one.className)(document.activeElement)"""
NAME = """(one => one.getAttribute("aria-label") || one.textContent.trim()
    || one.closest("label")?.textContent.trim() || one.title)(document.activeElement)"""


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Path:
    formats.write(tmp_path / "scene.html", coloured_scene(), views=views())
    return tmp_path / "scene.html"


@pytest.fixture
def phone(browser: Browser) -> Iterator[Browser]:
    screen: dict[str, Any] = {"width": PHONE[0], "height": PHONE[1], "deviceScaleFactor": 1}
    browser.call("Emulation.setDeviceMetricsOverride", mobile=True, **screen)
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
    yield browser
    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)


def opened(browser: Browser, page: Path) -> None:
    browser.open(page.as_uri() + "?webgl")
    browser.run("window.splatReady")


def box(browser: Browser, element: str) -> dict[str, float]:
    return dict(json.loads(browser.run(BOX.format(element))))


def test_on_a_phone_nothing_lies_over_the_scene_and_a_finger_meets_each_control(
    phone: Browser, page: Path
) -> None:
    opened(phone, page)
    phone.run("new Promise(done => setTimeout(done, 600))")  # the hint fades away
    scene = box(phone, "canvas")
    assert scene["height"] > 0.8 * PHONE[1]
    assert scene["width"] == PHONE[0]
    assert not phone.run("document.getElementById('controls').checkVisibility()")
    folded = json.loads(phone.run(BOXES))
    assert len(folded) > 5
    for name, at in folded:
        assert at["bottom"] <= scene["top"] + 1 or at["top"] >= scene["bottom"] - 1, name
    phone.run("document.getElementById('fold').click()")
    phone.run("document.getElementById('select').open = true")
    every = json.loads(phone.run(BOXES))
    assert len(every) > len(folded) + 8
    for name, at in every:
        assert min(at["width"], at["height"]) >= FINGER_PX, name
        assert 0 <= at["left"] < at["right"] <= PHONE[0], name
    assert box(phone, "#panel")["bottom"] <= box(phone, "canvas")["top"] + 1


def press(browser: Browser, key: str, code: int = 0) -> None:
    text: dict[str, Any] = {"text": key} if len(key) == 1 else {}
    for kind in ("keyDown", "keyUp"):
        browser.call(
            *("Input.dispatchKeyEvent",),
            type=kind,
            key=key,
            code=key,
            windowsVirtualKeyCode=code or ord(key[0].upper()),
            **text,
        )


def test_the_keyboard_reaches_every_control_and_each_has_a_name(
    browser: Browser, page: Path
) -> None:
    browser.resize((1000, 700))
    opened(browser, page)
    browser.run("document.getElementById('select').open = true")
    wanted = browser.run(
        "[...document.querySelectorAll('button, select, summary, input, textarea, [role=button]')]"
        ".filter(one => !one.disabled && one.checkVisibility({visibilityProperty: true}))"
        ".map(one => one.id || one.className)"
    )
    reached = {}
    for _ in range(3 * len(wanted)):
        press(browser, "Tab", 9)
        reached[browser.run(FOCUSED)] = browser.run(NAME)
    assert set(wanted) <= set(reached)
    for one in wanted:
        assert reached[one], one


def test_a_button_with_the_focus_takes_the_key_that_presses_it_from_the_viewer(
    browser: Browser, page: Path
) -> None:
    browser.resize((1000, 700))
    opened(browser, page)
    shown = "document.getElementById('shot').value"
    first = browser.run(shown)
    browser.run("window.spaces = 0; window.addEventListener('keydown', () => window.spaces++)")
    browser.run("document.getElementById('next').focus()")
    press(browser, " ", 32)
    assert browser.run(shown) != first
    assert browser.run("window.spaces") == 0
    assert browser.run(FOCUSED) == "next"
    press(browser, "Escape", 27)
    assert browser.run("document.activeElement === document.body")


def test_keys_step_through_the_cameras(browser: Browser, page: Path) -> None:
    browser.resize((1000, 700))
    opened(browser, page)
    shown = "document.getElementById('shot').selectedIndex"
    browser.run("document.activeElement.blur()")
    assert browser.run(shown) == 0
    press(browser, ".", 190)
    press(browser, ".", 190)
    assert browser.run(shown) == 2
    press(browser, ",", 188)
    assert browser.run(shown) == 1
    browser.run("document.querySelector('.sse-flyCamera').click()")
    note = "document.getElementById('note').textContent"
    assert "Moved" in browser.run(note)
    press(browser, "b", 66)
    assert browser.run(note) == ""
    press(browser, "f", 70)
    assert browser.run(shown) == 0  # not back to where all is seen, outside of a room


def test_a_page_for_a_client_has_its_title_background_and_full_screen_and_no_panel(
    browser: Browser, tmp_path: Path
) -> None:
    ply.write(tmp_path / "secret.ply", coloured_scene())
    out = tmp_path / "client.html"
    options = ("--save", str(out), "--title", "A <chair>", "--background", "#204060")
    result = CliRunner().invoke(app, ["view", str(tmp_path / "secret.ply"), *options])
    assert result.exit_code == 0, result.stderr
    assert "secret" not in out.read_text(encoding="utf-8")
    browser.resize((600, 400))
    browser.open(out.as_uri() + "?webgl")
    browser.run("window.splatReady")
    assert browser.run("document.title") == "A <chair>"
    assert browser.run("document.getElementById('panel').checkVisibility()") is False
    for control in ("enterFullscreen", "play"):
        assert browser.run(f"document.querySelector('.sse-{control}').checkVisibility()"), control
    found = np.round(255 * browser.picture()[60:300]).reshape(-1, 3)
    assert (np.abs(found - (0x20, 0x40, 0x60)).max(1) <= 1).mean() > 0.1
    assert len(formats.read(out)) == len(coloured_scene())


@pytest.mark.parametrize(
    "wrong", [["--save", "a.ply"], ["--save", "a.html", "--background", "red"]]
)
def test_a_page_for_a_client_says_what_it_wants(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ply.write(tmp_path / "scene.ply", coloured_scene())
    result = CliRunner().invoke(app, ["view", "scene.ply", *wrong])
    assert (result.exit_code, "view-page" in result.stderr) == (2, True)
    assert not list(tmp_path.glob("a.*"))
