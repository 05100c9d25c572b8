"""The browser that tests bring: complete, and told apart when it dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.packages import UnavailableError
from tests.viewer.browser import Browser, chromium

# A Chromium without fonts draws no letter of the first kind, and ends at the second.
FONTS = ("sans-serif", "serif", "monospace", "system-ui", "Courier New")


def page_of(body: str) -> str:
    return "data:text/html;charset=utf-8," + quote(body)


@pytest.mark.parametrize("family", FONTS)
def test_text_of_every_script_is_drawn(browser: Browser, family: str) -> None:
    browser.open(page_of(f'<p style="font: 20px {family}">Letters <button>again</button>'))
    assert browser.run("document.fonts.ready.then(() => 7)") == 7
    assert (browser.picture().min(axis=2) < 0.5).sum() > 100


def test_controls_and_other_scripts_do_not_end_it(browser: Browser) -> None:
    browser.open(page_of("<select><option>s</select><input type=range><code>x</code>日本 Привет ✓"))
    assert browser.picture().std() > 0.01


@pytest.mark.skipif(os.name != "posix", reason="sends a signal")
def test_a_browser_that_crashes_is_reported_with_its_last_output(tmp_path: Path) -> None:
    try:
        dying = Browser(chromium(), tmp_path, (64, 48))
    except UnavailableError as reason:
        pytest.skip(str(reason))
    with (tmp_path / "stderr.txt").open("a") as errors:
        errors.write("no font for that\n")
    os.kill(dying._process.pid, signal.SIGSEGV)
    with pytest.raises(AssertionError, match=r"status -11:(.|\n)*no font for that"):
        dying.open("about:blank")
    dying.close()
