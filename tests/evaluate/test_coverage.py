"""Coverage of captures whose gaps are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.evaluate.coverage import (
    CameraLayout,
    Patches,
    camera_layout,
    find_gaps,
    patches_of,
    poorly_covered_regions,
)
from stages.formats.values import concatenate
from stages.scene import Camera, Splats
from tests.evaluate.rings import MIDDLE, ball, camera, place, ring, surface


def sides(splats: Splats, cameras: list[Camera]):
    patches = patches_of(splats, cameras, "cpu")
    layout = camera_layout(cameras, patches, levelled=True)
    return layout, find_gaps(layout, patches, cameras)


def test_a_scene_seen_from_one_side_has_its_gap_at_the_back() -> None:
    seen, found = sides(surface(ball()), ring([-30, -15, 0, 15, 30]))
    assert seen.inward
    assert abs(float(seen.azimuths_deg(found[0].direction))) > 150
    assert found[0].angle_deg > 90


@pytest.mark.parametrize("heading", [-90, 0, 135])
def test_the_gap_is_where_photographs_were_taken_away(heading: int) -> None:
    every = [*range(-180, 180, 20)]
    _, none = sides(surface(ball()), ring(every))
    assert [gap for gap in none if gap.direction[1] > -0.6] == []  # from above there is one
    left = [h for h in every if abs((h - heading + 180) % 360 - 180) > 60]
    seen, found = sides(surface(ball()), ring(left))
    away = float(seen.azimuths_deg(found[0].direction)) - heading
    assert abs((away + 180) % 360 - 180) < 30  # of the 140 degrees that are empty


def test_a_ring_that_stays_low_has_its_gap_above() -> None:
    seen, found = sides(surface(ball()), ring(range(-180, 180, 20), height=10))
    assert float(seen.elevations_deg(found[0].direction)) > 65


def test_no_gap_is_behind_a_wall() -> None:
    directions = np.array([place(heading, 20, 1.0) for heading in range(-80, 81, 20)])
    seen = CameraLayout(True, MIDDLE, directions, np.array([0.0, -1.0, 0.0]), 4.0)
    across, up = (
        axis.ravel() for axis in np.meshgrid(np.arange(-8, 8, 0.5), np.arange(-8, 8, 0.5))
    )
    wall, n = np.stack([across, up, np.full(len(up), -2.5)], axis=1), len(up)
    once = np.ones((n, 1), bool)
    patches = Patches(wall, 0.5, np.full(n, 0.25), once, np.zeros(n, np.intp), np.zeros(n))
    cameras = ring([-80, 80])
    free = find_gaps(seen, replace(patches, area=np.zeros(n)), cameras)
    assert 4 * free[0].direction[2] < -2.5
    found = find_gaps(seen, patches, cameras)
    assert found
    assert all(4 * gap.direction[2] > -2.5 for gap in found)


@pytest.mark.parametrize("headings", [range(-60, 61, 20), range(-30, 31, 15)])
def test_no_gap_is_behind_the_wall_that_a_thing_hangs_on(headings: range) -> None:
    """No picture shows the wall's edge, nor how high it is."""
    line = np.arange(-40.0, 40.0, 0.5)
    across, up = (axis.ravel() for axis in np.meshgrid(line, line))
    wall = surface(np.stack([across, up, np.full(len(up), -1.0)], axis=1), 0.4)
    seen, found = sides(concatenate([surface(ball()), wall]), ring([*headings]))
    assert found
    assert all((seen.middle + seen.distance * gap.direction)[2] > -1 for gap in found)


def test_cameras_that_look_outward_have_a_gap_where_none_looks() -> None:
    room = surface(ball(5.0, 4000), 0.25)
    targets = [place(heading, 0, 5.0) for heading in range(-120, 121, 20)]
    cameras = [camera(-0.1 * target, target) for target in targets]
    seen, found = sides(room, cameras)
    assert not seen.inward
    assert abs(float(seen.azimuths_deg(found[0].direction))) > 150


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
