"""Where a scene is on the earth."""

from __future__ import annotations

import numpy as np
import pytest

from stages.scene import load_splats, save_splats
from stages.scene.place import (
    EAST_DOWN_NORTH,
    GEOGRAPHIC,
    EarthPlace,
    east_north_up,
    geocentric,
    geodetic,
    local_positions,
)
from tests.formats.truth import many_splats

EQUATOR, POLAR = 6_378_137.0, 6_356_752.3142  # half axes of WGS 84, metres (NIMA TR8350.2)
MILLIMETRE = 1e-3


def test_geocentric_positions_of_known_places() -> None:
    places = np.array([[0, 0, 0], [0, 90, 10], [90, 0, 100], [-90, 0, 0]], np.float64)
    wanted = [[EQUATOR, 0, 0], [0, EQUATOR + 10, 0], [0, 0, POLAR + 100], [0, 0, -POLAR]]
    np.testing.assert_allclose(geocentric(places), wanted, atol=MILLIMETRE)


def test_geodetic_is_the_inverse_of_geocentric() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform([-89.99, -180, -5000], [89.99, 180, 90_000], (500, 3))
    back = geodetic(geocentric(places))
    np.testing.assert_allclose(back[:, :2], places[:, :2], atol=1e-10)
    np.testing.assert_allclose(back[:, 2], places[:, 2], atol=MILLIMETRE)


def test_local_axes_are_right_handed_and_up_is_away_from_the_ellipsoid() -> None:
    for place in ([0.0, 90.0, 0.0], [47.4, 8.5, 400.0], [-33.9, 151.2, 5.0]):
        axes = east_north_up(np.array(place))
        np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)
        above = geodetic(geocentric(np.array(place)) + 7.0 * axes[2])
        np.testing.assert_allclose(above, np.add(place, [0, 0, 7]), atol=MILLIMETRE)


def test_local_positions_across_the_date_line_are_near_each_other() -> None:
    """By hand: 0.0001 degrees of the equator are 11.13 m."""
    places = np.array([[0.0, 179.9999, 0.0], [0.0, -179.9999, 0.0]])
    local = local_positions(places, np.array([0.0, 180.0, 0.0]))
    np.testing.assert_allclose(local[:, 0], [-11.132, 11.132], atol=MILLIMETRE)
    np.testing.assert_allclose(local[:, 1:], 0, atol=MILLIMETRE)


@pytest.mark.parametrize("crs", [GEOGRAPHIC, "EPSG:25832"])
def test_a_moved_world_lies_where_it_lay(crs: str) -> None:
    """A point of the new world has the coordinates of the same point of the old one."""
    offset = np.array([47.4, 8.5, 400.0] if crs == GEOGRAPHIC else [465e3, 5.2e6, 400.0])
    place = EarthPlace(crs, offset, 2.0 * EAST_DOWN_NORTH)
    c, s = np.cos(0.3), np.sin(0.3)
    old_from_new = np.eye(4)
    old_from_new[:3] = [[3 * c, -3 * s, 0, 500], [3 * s, 3 * c, 0, -20], [0, 0, 3, 900]]
    point = np.array([4.0, 5.0, 6.0])
    new = place.moved(old_from_new)
    before = place.beside(old_from_new[:3, :3] @ point + old_from_new[:3, 3])
    after = new.beside(point)
    np.testing.assert_allclose(after.offset, before.offset, atol=1e-9)
    np.testing.assert_allclose(after.axes, before.axes @ old_from_new[:3, :3], atol=1e-9)


def test_a_place_is_stored_with_its_splats(tmp_path) -> None:
    place = EarthPlace("EPSG:25832", np.array([465e3 + 0.125, 5.2e6, 400.0]), EAST_DOWN_NORTH)
    splats = many_splats(5)
    save_splats(tmp_path / "without.bin", splats)
    assert load_splats(tmp_path / "without.bin").place is None
    object.__setattr__(splats, "place", place)
    save_splats(tmp_path / "with.bin", splats)
    back = load_splats(tmp_path / "with.bin").place
    assert back is not None
    assert back.to_json() == place.to_json()
