"""What the report says of captures whose gaps are known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from stages.evaluate.evaluation import EvaluationView
from stages.scene import DrawSettings, Splats, View
from stages.tradeoff.curves import Coverage, Tradeoff
from stages.tradeoff.measurement import measure_coverage, measure_framings
from stages.tradeoff.shimmer import Framing
from stages.tradeoff.summary import about_coverage, about_framing
from tests.evaluate.rings import ball, camera, place, ring, surface


def ball_splats() -> Splats:
    return replace(surface(ball()), draw_settings=DrawSettings(near=0.01, side=96))


def coverage_of(
    headings: Sequence[int], height: int = 20, floaters: Iterable[int] = ()
) -> Coverage:
    """Photographs around a ball, named by where they were taken: "at 40.jpg"."""
    splats, cameras = ball_splats(), ring(headings, height)
    views = [View(f"at {h}.jpg", "", c) for h, c in zip(headings, cameras, strict=True)]
    is_floater = np.isin(np.arange(len(splats)), list(floaters))
    return measure_coverage(splats, views, True, is_floater, "cpu")


def coverage_text(coverage: Coverage) -> str:
    return "\n".join(about_coverage(cast(Tradeoff, SimpleNamespace(coverage=coverage))))


def framing_text(framings: Sequence[Framing], small_psnr_db: tuple[float, float]) -> str:
    values: Any = SimpleNamespace(framings=framings, small_psnr_db=small_psnr_db)
    return "\n".join(about_framing(values))


def first_gap(coverage: Coverage) -> str:
    lines = coverage_text(coverage).splitlines()
    return next(line for line in lines if line.startswith("Gap 1"))


def test_the_back_is_named_by_the_photograph_opposite() -> None:
    line = first_gap(coverage_of([-30, -15, 0, 15, 30]))
    assert line.startswith("Gap 1, opposite at 0, in the ")
    assert "° from at 30 round to at -30" in line
    assert "Take one from there, if possible." in line


def test_the_text_follows_the_side_whose_photographs_are_removed() -> None:
    every = range(-180, 180, 20)
    assert "straight above" in first_gap(coverage_of([*every]))
    right = coverage_of([h for h in every if not 20 < h < 160], height=40)
    left = coverage_of([h for h in every if not -160 < h < -20], height=40)
    assert "between at 20 and at 160" in first_gap(right)
    assert "between at -160 and at -20" in first_gap(left)


def test_floaters_are_named_by_the_nearest_photograph() -> None:
    coverage = coverage_of([0, 120, -120])
    assert "no floaters" in coverage_text(coverage)
    before = np.array([place(120, 20, 3.5)] * 3 + [place(0, 20, 3.5)])
    text = coverage_text(replace(coverage, floaters=before))
    assert "4 splats are floaters" in text
    assert "most of them near at 120 (3), at 0 (1)" in text


def test_the_framing_that_shimmers_most_is_named() -> None:
    view = EvaluationView("a", camera(place(0)), np.full((72, 96, 3), 128, np.uint8))
    found = measure_framings(ball_splats(), [view], coverage_of([-30, 0, 30]), "cpu")
    assert found[-1].label == "from gap 1"
    loud = replace(found[2], shimmer=99.0)
    assert f"most {loud.label}: 99.0" in framing_text((found[0], loud), (29.0, 29.1))


def test_pictures_that_thicken_when_small_should_be_scaled_down() -> None:
    found = [Framing(label, np.zeros((1, 1, 3), np.float32), 1.0) for label in "ab"]
    assert "scale down" in framing_text(found, (18.0, 29.0))
    assert "Splats look thicker" not in framing_text(found, (29.0, 29.1))


def test_a_capture_that_shows_no_splat_is_reported() -> None:
    nothing = replace(coverage_of([0]), layout=None, gaps=(), regions=())
    assert coverage_text(nothing) == "No training view shows any splat."
