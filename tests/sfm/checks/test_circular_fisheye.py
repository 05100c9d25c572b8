"""Circular fisheyes without known cameras are warned of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.scene import IGNORE, Capture
from stages.sfm import stage as sfm
from stages.sfm.checks.circular_fisheye import warn_of_circular_fisheye
from stages.sfm.settings import SfmSettings
from tests.ingest.made_files import textured
from tests.sfm.checks import bad_captures

SIDE = 200


def circular(folder: Path, count: int = 4) -> Capture:
    """Circles of a scene on black."""
    x, y = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
    inside = (np.hypot(x, y) < SIDE / 2 - 1)[..., None]
    images = {f"{i}.png": np.where(inside, textured(i, SIDE, SIDE), 0) for i in range(count)}
    return bad_captures.capture_of(folder, images)


def codes(capture: Capture) -> list[str]:
    report = Report()
    warn_of_circular_fisheye(capture, report)
    return [code for code, _ in report.warnings]


def test_circles_are_warned_of_unless_masks_say_what_counts(tmp_path: Path) -> None:
    capture = circular(tmp_path)
    assert codes(capture) == ["sfm-circular-fisheye"]
    masked = (replace(photo, mask="masks/a.png", outside=IGNORE) for photo in capture.photos)
    assert codes(Capture(tmp_path, tuple(masked))) == []


def test_the_sample_is_not_warned_of() -> None:
    assert codes(bad_captures.sample(12)) == []


def test_the_stage_warns_before_it_searches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise Interrupted

    monkeypatch.setattr(sfm, "check_one_place", stopped)
    capture, report = circular(tmp_path / "photos"), Report()
    with pytest.raises(Interrupted):
        sfm.run({"ingest": capture}, SfmSettings(), tmp_path / "out", report)
    assert "sfm-circular-fisheye" in dict(report.warnings)
