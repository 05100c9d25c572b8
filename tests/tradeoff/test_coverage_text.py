"""What the report says of captures whose coverage is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np

from stages.scene import Camera, DrawSettings, Splats, View
from stages.tradeoff.curves import Tradeoff
from stages.tradeoff.measurement import measure_coverage
from stages.tradeoff.report_text import about_coverage
from tests.evaluate.rings import ball, ring, surface


def coverage_text(splats: Splats, cameras: list[Camera]) -> list[str]:
    views = [View(f"{i}.jpg", "", camera) for i, camera in enumerate(cameras)]
    splats = replace(splats, draw_settings=DrawSettings(near=0.01, side=96))
    coverage = measure_coverage(splats, views, "cpu")
    return about_coverage(cast(Tradeoff, SimpleNamespace(coverage=coverage)))


def test_a_surface_that_one_photograph_shows_is_named_by_its_place_there() -> None:
    first, *regions = coverage_text(surface(ball()), ring([0]))
    assert first.startswith("Of the surfaces that the photographs show, 100% are poorly covered")
    assert regions[0].startswith("Middle in 0: seen by 1 view; ")


def test_a_capture_that_shows_no_splat_is_reported() -> None:
    away = surface(ball() + np.array([0.0, 0.0, -50.0]))
    assert coverage_text(away, ring([0])) == ["No training view shows any splat."]
