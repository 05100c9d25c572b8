"""What the report says of captures whose gaps are known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np

from stages.scene import DrawSettings, Splats, View
from stages.tradeoff.curves import Coverage, Tradeoff
from stages.tradeoff.measurement import measure_coverage
from stages.tradeoff.report_text import about_coverage
from tests.evaluate.rings import ball, place, ring, surface


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


def test_a_capture_that_shows_no_splat_is_reported() -> None:
    nothing = replace(coverage_of([0]), layout=None, gaps=(), regions=())
    assert coverage_text(nothing) == "No training view shows any splat."
