"""Progress as lines: seldom, with pace and figures."""

from __future__ import annotations

import io
import re
import time
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from splatcli import console, progress

STAGE: Any = SimpleNamespace(name="train")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(time, "monotonic", lambda: now.s)
    return now


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []
    monkeypatch.setattr(console, "note", lambda text, style="": said.append(text))
    return said


def test_lines_come_at_intervals_with_rate_and_time_left(clock, lines) -> None:
    listener = progress.Lines()
    listener.started(STAGE, 4, "has not run yet", False)
    for step in range(101):
        clock.s = 100.0 + step * 0.5  # 2 steps a second
        listener.progressed(STAGE, "training", step, 100, {"splats": 12000, "psnr_db": 20.0})
    assert lines[:3] == [
        "4/7 train: runs (has not run yet)",
        "  training: 0/100, splats 12,000, PSNR 20 dB",
        "  training: 20/100, 2.0/s, 40.0 s left, splats 12,000, PSNR 20 dB",
    ]
    assert len(lines) == 7


def test_label_that_names_each_photograph_is_one_phase(clock, lines) -> None:
    listener = progress.Lines()
    listener.started(STAGE, 1, "has not run yet", False)
    for done in range(300):
        clock.s += 0.01
        listener.progressed(STAGE, f"IMG_{done}.jpg", done, 300, {})
    assert len(lines) == 2


def test_a_new_phase_is_printed_at_once(clock, lines) -> None:
    listener = progress.Lines()
    listener.started(STAGE, 2, "has not run yet", False)
    for label in ("finding features", "registering photographs"):
        for done in range(25):
            listener.progressed(STAGE, label, done, 24, {"photographs": done})
    assert lines[1:] == ["  finding features: 0/24", "  registering photographs: 0/24"]


def test_equal_pictures_are_exact_in_the_bar_too() -> None:
    assert console.figures({"verify_db": 99.0}) == "verify exact"
    assert console.figures({"verify_db": 38.28}) == "verify 38.28 dB"


def test_slow_units_are_seconds_each(clock, lines) -> None:
    listener = progress.Lines()
    listener.progressed(STAGE, "matching", 0, 3, {})
    clock.s += 30
    listener.progressed(STAGE, "matching", 2, 3, {})
    assert lines[-1] == "  matching: 2/3, 15.0 s each, 15.0 s left"


@pytest.mark.parametrize("width", [80, 200])
def test_the_bar_of_training_shows_step_pace_and_time_left_at_any_width(
    width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=width, color_system=None)
    monkeypatch.setattr(console, "err", screen)
    listener = progress.Bars()
    listener.started(STAGE, 4, "has not run yet", False)
    numbers: dict[str, float | int | str] = {
        "splats": 46913,
        "loss": 0.0123,
        "held_out_psnr_db": 27.11,
        "ssim": 0.8776,
    }
    for step in (0, 100, 300):
        listener.progressed(STAGE, "training a long_name_of_a_photograph.jpg", step, 2000, numbers)
        time.sleep(0.02)
    drawn = listener._progress
    assert drawn is not None
    plain = Console(file=io.StringIO(), width=width)
    plain.print(drawn.get_renderable())
    first, second = plain.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert re.search(r"4/7 train +training a long.* 300/2000 .*\d/s \d+:\d\d$", first.rstrip())
    assert "splats 46,913" in second
    assert "held out PSNR 27.11 dB" in second
    assert max(len(first), len(second)) <= width
    listener.ended()
