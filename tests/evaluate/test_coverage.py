"""Coverage of captures in which it is known."""

from __future__ import annotations

import numpy as np
import pytest

from stages.evaluate.coverage import patches_of, poorly_covered_regions
from tests.evaluate.rings import ball, camera, place, ring, surface


def test_occluded_surfaces_are_not_seen() -> None:
    behind, before = place(180, 0, 1.0), place(0, 0, 1.0)
    patches = patches_of(surface(ball()), ring([-5, 0, 5]), "cpu")
    apart = [np.linalg.norm(patches.centres - at, axis=1).min() for at in (before, behind)]
    assert apart[0] < patches.side
    assert apart[1] > 0.5


def test_a_surface_is_seen_over_the_angle_between_its_photographs() -> None:
    patches = patches_of(surface(ball(0.5, 600), 0.05), ring([0, 30], height=0), "cpu")
    both = patches.counts == 2
    assert both.any()
    assert patches.angles_deg[both] == pytest.approx(30, abs=5)
    assert not patches.angles_deg[~both].any()


def test_what_only_one_photograph_shows_is_a_poorly_covered_region_of_it() -> None:
    lonely = ball(0.4, 300) + np.array([0.0, 0.0, 30.0])
    cameras = [*ring(range(-180, 180, 30)), camera(place(0, 10, 10.0), np.array([0, 0, 30.0]))]
    splats = surface(np.concatenate([ball(), lonely]))
    patches = patches_of(splats, cameras, "cpu")
    first = poorly_covered_regions(patches)[0]
    assert (first.best, first.views, first.angle_deg) == (len(cameras) - 1, 1, 0)
    assert np.linalg.norm(first.centre - [0, 0, 30]) < 1


def test_splats_that_nothing_shows_make_no_patches() -> None:
    patches = patches_of(surface(ball() + np.array([0.0, 0.0, -50.0])), ring([0]), "cpu")
    assert len(patches.centres) == 0
