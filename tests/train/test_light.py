"""Whether training corrects the light of photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from stages.base.stage import Report
from stages.scene import Reconstruction
from stages.scene.light import Light
from stages.train.build import corrects_light
from tests.small_scene import small_scene


def lit(folder: Path, light: Light | None) -> Reconstruction:
    """Every second photograph has this light, the others 0."""
    whole = small_scene(folder, views=4).reconstruction
    lights = (light, light and (0.0, 0.0, 0.0)) * 2
    views = (replace(v, light=each) for v, each in zip(whole.views, lights, strict=True))
    return replace(whole, views=tuple(views))


@pytest.mark.parametrize(
    ("ev", "choice", "corrects"),
    [(0.4, "auto", True), (0.4, "off", False), (0.0, "auto", False), (None, "auto", False)],
)
def test_the_light_that_structure_from_motion_found_is_corrected_unless_it_is_off(
    tmp_path: Path, ev: float | None, choice: str, corrects: bool
) -> None:
    report = Report()
    light = None if ev is None else (ev, ev, ev)
    assert corrects_light(lit(tmp_path, light), choice, report) is corrects
    assert [code for code, _ in report.warnings] == ["train-light-evened"] * corrects
    assert report.metrics["light_corrected"] is corrects
