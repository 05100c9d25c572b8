"""What the report says of captures of which it is known what they leave out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from stages.measure.evaluation import EvaluationView
from stages.measure.tradeoff.curves import Trade
from stages.measure.tradeoff.thin import Thin, measure_thin
from stages.measure.tradeoff.thin_words import about_coverage, about_framing
from stages.scene import DrawSettings, View
from tests.measure.rings import ball, camera, place, ring, surface


def thin_of(headings: Sequence[int], height: int = 20, hanging: Iterable[int] = ()) -> Thin:
    """Photographs around a ball, named by where they stand: "at 40.jpg"."""
    splats = replace(surface(ball()), draw_settings=DrawSettings(near=0.01, side=96))
    cameras = ring(headings, height)
    views = [View(f"at {h}.jpg", "", c) for h, c in zip(headings, cameras, strict=True)]
    grey = np.full((72, 96, 3), 128, np.uint8)
    judge = EvaluationView("judge", camera(place(0)), grey)
    mask = np.isin(np.arange(len(splats)), list(hanging))
    return measure_thin(splats, views, True, [judge], mask, "cpu")


def told(thin: Thin, about: Any = about_coverage) -> str:
    return "\n".join(about(cast(Trade, SimpleNamespace(thin=thin))))


def first_gap(thin: Thin) -> str:
    return next(line for line in told(thin).splitlines() if line.startswith("Gap 1"))


def test_the_back_is_named_by_the_photograph_opposite() -> None:
    said = first_gap(thin_of([-30, -15, 0, 15, 30]))
    assert said.startswith("Gap 1, opposite at 0, in the ")
    assert "° from at 30 round to at -30" in said
    assert "Stand there, if one can." in said


def test_the_words_move_to_the_side_whose_photographs_are_taken_away() -> None:
    every = range(-180, 180, 20)
    assert "straight above" in first_gap(thin_of([*every]))
    right = thin_of([h for h in every if not 20 < h < 160], height=40)
    left = thin_of([h for h in every if not -160 < h < -20], height=40)
    assert "between at 20 and at 160" in first_gap(right)
    assert "between at -160 and at -20" in first_gap(left)


def test_floaters_are_told_by_the_photograph_that_they_hang_before() -> None:
    thin = thin_of([0, 120, -120])
    assert "No splat hangs" in told(thin)
    before = np.array([place(120, 20, 3.5)] * 3 + [place(0, 20, 3.5)])
    assert "4 splats hang" in told(replace(thin, floaters=before))
    assert "most before at 120 (3), at 0 (1)" in told(replace(thin, floaters=before))


def test_the_framings_are_shown_and_the_one_that_shimmers_most_is_named() -> None:
    thin = thin_of([-30, 0, 30])
    assert thin.framings[-1].label == "from gap 1"
    loud = replace(thin.framings[2], shimmer=99.0)
    assert f"most {loud.label}: 99.0" in told(
        replace(thin, framings=(thin.framings[0], loud)), about_framing
    )


def test_pictures_that_thicken_when_small_are_told_to_be_scaled_down() -> None:
    thin = thin_of([-30, 0, 30])
    assert "scale down" in told(replace(thin, small_psnr_db=(18.0, 29.0)), about_framing)
    assert "Splats thicken" not in told(replace(thin, small_psnr_db=(29.0, 29.1)), about_framing)


def test_a_capture_that_shows_no_splat_is_told_in_words() -> None:
    thin = thin_of([0])
    nothing = replace(thin, ring=None, gaps=(), places=())
    assert told(nothing) == "No photograph of training shows any splat."
