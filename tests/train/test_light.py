"""Whether training corrects the light and the vignetting of photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from stages.base.stage import Report
from stages.scene import Reconstruction
from stages.scene.light import Light
from stages.train.build import corrects_light, corrects_vignetting
from tests.small_scene import small_scene


def lit(folder: Path, light: Light | None, explained: float) -> Reconstruction:
    """Every second photograph has this light, the others 0."""
    whole = small_scene(folder, views=4).reconstruction
    lights = (light, light and (0.0, 0.0, 0.0)) * 2
    views = (replace(v, light=each) for v, each in zip(whole.views, lights, strict=True))
    return replace(whole, views=tuple(views), light_explained=explained)


@pytest.mark.parametrize(
    ("ev", "explained", "choice", "corrects", "codes"),
    [
        (0.4, 0.8, "auto", True, ["train-light-evened"]),
        (0.4, 0.3, "auto", False, ["train-light-not-evened"]),
        (0.4, 0.3, "on", True, []),
        (0.4, 0.3, "off", False, []),
        (0.01, 0.3, "auto", False, []),
        (0.01, 0.3, "on", True, []),
        (None, 0.0, "auto", False, []),
        (None, 0.0, "on", True, ["train-light-unknown"]),
    ],
)
def test_on_is_obeyed_and_auto_says_what_it_leaves(
    tmp_path: Path,
    ev: float | None,
    explained: float,
    choice: str,
    corrects: bool,
    codes: list[str],
) -> None:
    report = Report()
    light = None if ev is None else (ev, ev, ev)
    assert corrects_light(lit(tmp_path, light, explained), choice, report) is corrects
    assert [code for code, _ in report.warnings] == codes
    assert report.metrics["light_corrected"] is (corrects and ev is not None)


def test_vignetting_is_corrected_where_it_was_found(tmp_path: Path) -> None:
    even = small_scene(tmp_path, views=4).reconstruction
    views = (replace(even.views[0], vignetting=(0.3, 0.0, 0.0)), *even.views[1:])
    for choice in ("auto", "on"):
        assert corrects_vignetting(replace(even, views=views), choice, Report())
        assert not corrects_vignetting(even, choice, Report())
    report = Report()
    assert not corrects_vignetting(replace(even, views=views), "off", report)
    assert report.metrics["vignetting_corrected"] is False
