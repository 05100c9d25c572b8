"""Where a reconstruction lies: from GPS, and in the grid that is requested."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.scene import Camera, Face, Photo
from stages.scene.place import (
    EAST_DOWN_NORTH,
    GEOGRAPHIC,
    EarthPlace,
    east_north_up,
    geocentric,
    geodetic,
)
from stages.sfm.place.crs import in_crs, projected_system, turned_to_grid
from stages.sfm.place.gps import MetricScale, about_vertical
from stages.sfm.place.metric_scale import UNKNOWN_SCALE, KnownScale, find_metric_scale

HOME = np.array([47.3769, 8.5417, 408.0])
METRES, TURN = 7.0, 0.8
CENTIMETRE = 0.01


def flight(count: int = 30, seed: int = 0) -> np.ndarray:
    """[V, 3] metres east, north and up of HOME: a drone over 120 m, at two heights."""
    rng = np.random.default_rng(seed)
    where = rng.uniform(-60, 60, (count, 3))
    where[:, 2] = np.where(np.arange(count) % 2, 30.0, 45.0)
    return where


def world_of(local: np.ndarray, tilt: float = 0.0) -> np.ndarray:
    """[V, 3] the same in an arbitrary world, y down: moved, scaled and rotated, also tilted."""
    c, s = np.cos(tilt), np.sin(tilt)
    tilted = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    new_from_world = METRES * tilted @ about_vertical(TURN)
    return (local @ EAST_DOWN_NORTH - [10.0, 5.0, -20.0]) @ np.linalg.inv(new_from_world).T


def on_earth(local: np.ndarray) -> np.ndarray:
    return geodetic(geocentric(HOME) + local @ east_north_up(HOME))


def photographs(places: np.ndarray, error_m: float | None = None) -> list[Photo]:
    blank = Photo("", "", 640, 480, None, "c", 3.0, -2.0, None, gps_error_m=error_m)
    return [
        replace(blank, name=f"{i}.jpg", gps=(place[0], place[1]), gps_height=place[2])
        for i, place in enumerate(places.tolist())
    ]


def placed(
    photos: list[Photo], centres: np.ndarray, known: KnownScale = UNKNOWN_SCALE
) -> tuple[MetricScale, Report]:
    report = Report()
    cameras = []
    for centre in centres:
        pose = np.eye(4)
        pose[:3, 3] = -centre
        cameras.append(Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose))
    found = find_metric_scale(known, photos, cameras, [], True, report)
    assert found is not None
    return found, report


def geographic(found: MetricScale, centres: np.ndarray) -> np.ndarray:
    """Latitude, longitude and height of the cameras in the new world."""
    assert found.place is not None
    return np.array([found.place.beside(p).offset for p in found.points(centres)])


def metres_apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(geocentric(a) - geocentric(b), axis=1).max())


def test_gps_says_where_every_camera_is() -> None:
    local = flight()
    found, report = placed(photographs(on_earth(local)), world_of(local))
    assert found.metres == pytest.approx(METRES, rel=1e-4)
    assert metres_apart(geographic(found, world_of(local)), on_earth(local)) < 2 * CENTIMETRE
    assert report.metrics["place"]["crs"] == GEOGRAPHIC
    np.testing.assert_allclose(report.metrics["place"]["axes"], EAST_DOWN_NORTH, atol=1e-4)


def test_corrected_positions_level_the_world_and_others_do_not() -> None:
    """Three degrees of tilt are 3 m of height over 60 m; RTK knows better, a phone does not."""
    local = flight()
    centres, truth = world_of(local, tilt=np.radians(3.0)), on_earth(local)
    measured = truth + [0, 0, 1] * np.random.default_rng(1).normal(0, 3, (len(truth), 1))
    rough, report = placed(photographs(measured), centres)
    assert "gps_in_three_dimensions" not in report.metrics
    np.testing.assert_allclose(rough.turn[1], [0, 1, 0], atol=1e-12)
    exact, report = placed(photographs(truth, error_m=0.02), centres)
    assert metres_apart(geographic(exact, centres), truth) < CENTIMETRE
    assert report.metrics["gps_in_three_dimensions"] == len(local)


@pytest.mark.parametrize("tilt_deg", [60.0, 90.0, 180.0])
def test_corrected_positions_say_the_level_where_cameras_do_not(tilt_deg: float) -> None:
    """A flight that looks straight down with one heading: its world may lie on its side."""
    local = flight()
    centres, truth = world_of(local, tilt=np.radians(tilt_deg)), on_earth(local)
    found, report = placed(photographs(truth, error_m=0.02), centres)
    assert found.metres == pytest.approx(METRES, rel=1e-3)
    assert metres_apart(geographic(found, centres), truth) < CENTIMETRE
    assert report.metrics["gps_in_three_dimensions"] == len(local)
    wrong = np.random.default_rng(3).permutation(truth)
    with pytest.raises(AssertionError):
        placed(photographs(wrong, error_m=0.02), centres)


def test_faces_of_a_panorama_have_one_position() -> None:
    """Two panoramas of twelve faces agree with any scale."""
    report = Report()
    photos: list[Photo] = []
    cameras: list[Camera] = []
    for photo in photographs(on_earth(flight(2))):
        for _ in range(12):
            face = Face("rig", photo.name, (1.0, 0.0, 0.0, 0.0))
            photos.append(replace(photo, name=f"{photo.name}/{len(photos)}", face=face))
            pose = np.eye(4)
            pose[0, 3] = len(cameras) // 12
            cameras.append(Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose))
    assert find_metric_scale(UNKNOWN_SCALE, photos, cameras, [], True, report) is None
    assert report.metrics["with_gps"] == 2
    assert "2 of 2 photographs" in dict(report.warnings)["sfm-gps-unused"]


def test_heights_that_a_tilt_explains_level_the_world() -> None:
    """A drone that looks straight down: its cameras say little of the level, its barometer more."""
    local = flight()
    centres, truth = world_of(local, tilt=np.radians(15.0)), on_earth(local)
    measured = truth + [0, 0, 1] * np.random.default_rng(2).normal(0, 0.3, (len(truth), 1))
    found, report = placed(photographs(measured), centres)
    assert report.metrics["gps_in_three_dimensions"] == len(local)
    assert metres_apart(geographic(found, centres), truth) < 0.5


def test_corrected_positions_on_a_line_do_not_tilt_the_world() -> None:
    """A single flight line: any rotation about it fits."""
    local = flight()
    local[:, 1] = 0.001 * np.arange(len(local))
    local[:, 2] = 30.0
    found, report = placed(photographs(on_earth(local), error_m=0.02), world_of(local))
    assert "gps_in_three_dimensions" not in report.metrics
    np.testing.assert_allclose(found.turn[1], [0, 1, 0], atol=1e-12)


def test_positions_without_heights_still_say_where_north_is() -> None:
    local = flight()
    photos = [replace(photo, gps_height=None) for photo in photographs(on_earth(local))]
    found, _ = placed(photos, world_of(local))
    level = geographic(found, world_of(local))
    level[:, 2] = on_earth(local)[:, 2]
    assert metres_apart(level, on_earth(local)) < 2 * CENTIMETRE


def test_a_scene_of_known_size_has_no_place() -> None:
    local = flight()
    found, report = placed(
        photographs(on_earth(local)), world_of(local), KnownScale(("0.jpg", "1.jpg", "3"))
    )
    assert found.place is None
    assert "place" not in report.metrics


def test_a_grid_is_the_world_plus_one_offset() -> None:
    """UTM zone 32 of the cameras, by PROJ, is the offset plus positions east and north."""
    pyproj = pytest.importorskip("pyproj")
    local = flight()
    known = KnownScale(crs="EPSG:25832")
    found, _ = placed(photographs(on_earth(local), error_m=0.02), world_of(local), known)
    assert found.place is not None
    east, down, north = found.points(world_of(local)).T
    truth = on_earth(local)
    utm = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:25832", always_xy=True)
    wanted = np.stack(utm.transform(truth[:, 1], truth[:, 0], truth[:, 2]), axis=1)
    x, y, z = found.place.offset
    np.testing.assert_allclose(east + x, wanted[:, 0], atol=CENTIMETRE)
    np.testing.assert_allclose(north + y, wanted[:, 1], atol=CENTIMETRE)
    np.testing.assert_allclose(z - down, wanted[:, 2], atol=3 * CENTIMETRE)  # 0.04 % of 45 m
    exact = found.place.offset + found.points(world_of(local)) @ found.place.axes.T
    np.testing.assert_allclose(exact, wanted, atol=CENTIMETRE)


def test_the_convergence_of_the_meridian_is_turned_away() -> None:
    """Zurich is 0.46 degrees west of the middle of its zone: grid north is 0.34 degrees off."""
    pytest.importorskip("pyproj")
    place = EarthPlace(GEOGRAPHIC, HOME, EAST_DOWN_NORTH)
    grid = in_crs(place, "EPSG:32632", Report())
    angle = np.degrees(np.arctan2(grid.axes[1, 0], grid.axes[0, 0]))
    assert angle == pytest.approx((HOME[1] - 9) * np.sin(np.radians(HOME[0])), abs=0.001)
    assert np.linalg.norm(grid.axes[:2, 0]) == pytest.approx(0.9996, abs=5e-5)


def test_a_place_in_one_grid_is_found_in_another() -> None:
    pytest.importorskip("pyproj")
    place = EarthPlace(GEOGRAPHIC, HOME, EAST_DOWN_NORTH)
    direct = in_crs(place, "EPSG:2056", Report())
    by_utm = in_crs(in_crs(place, "EPSG:32632", Report()), "EPSG:2056", Report())
    np.testing.assert_allclose(by_utm.offset, direct.offset, atol=CENTIMETRE)
    np.testing.assert_allclose(by_utm.axes, direct.axes, atol=1e-5)


def test_a_grid_that_is_a_mirror_image_is_refused() -> None:
    pytest.importorskip("pyproj")
    prague = EarthPlace(GEOGRAPHIC, np.array([50.08, 14.43, 250.0]), np.eye(3))
    with pytest.raises(SplatError) as raised:
        in_crs(prague, "EPSG:5513", Report())  # Krovak, to the south and west
    assert raised.value.code == "crs-not-projected"
    assert np.linalg.det(in_crs(prague, "EPSG:5514", Report()).axes) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("longitude", [179.9998, -179.9998])
def test_a_grid_is_used_beside_its_cut(longitude: float) -> None:
    """21 m from the 180th meridian, in Fiji, where EPSG:3857 goes from one end to the other."""
    pytest.importorskip("pyproj")
    fiji = EarthPlace(GEOGRAPHIC, np.array([-16.8, longitude, 5.0]), np.eye(3))
    axes = in_crs(fiji, "EPSG:3857", Report()).axes
    stretch = 1 / np.cos(np.radians(16.8))
    assert axes[:2, :2] == pytest.approx(stretch * np.eye(2), abs=0.01)


@pytest.mark.parametrize(("crs", "at"), [("EPSG:3857", (48, 11, 0)), ("EPSG:3031", (-75, 30, 0))])
def test_grids_of_all_longitudes_have_no_outside_there(crs: str, at: tuple[int, ...]) -> None:
    pytest.importorskip("pyproj")
    report = Report()
    in_crs(EarthPlace(GEOGRAPHIC, np.array(at, np.float64), np.eye(3)), crs, report)
    assert report.warnings == []


def in_grid(crs: str, place: EarthPlace) -> list[tuple[str, str]]:
    """The warnings."""
    report = Report()
    turned_to_grid(MetricScale(1.0, "gps", np.eye(3), place), crs, report)
    return report.warnings


@pytest.mark.parametrize(
    ("crs", "at", "stretch", "advice"),
    [
        ("EPSG:3857", (48, 11, 500), "1.494", "EPSG:32632."),
        ("EPSG:3857", (-34, 151, 0), "1.206", "EPSG:32756."),
        ("EPSG:3031", (-75, 30, 0), "0.9896", "EPSG:32736."),
        ("EPSG:3031", (-89, 30, 0), "0.9728", "Choose a system with a smaller region."),
    ],
)
def test_a_grid_whose_metres_are_not_those_of_the_ground_is_a_warning(
    crs: str, at: tuple[int, ...], stretch: str, advice: str
) -> None:
    pyproj = pytest.importorskip("pyproj")
    offset = np.array(at, np.float64)
    ((code, message),) = in_grid(crs, EarthPlace(GEOGRAPHIC, offset, EAST_DOWN_NORTH))
    assert code == "sfm-crs-stretched"
    assert f"{crs} stretches lengths by {stretch} here" in message
    assert message.endswith(advice)
    x, y = pyproj.Transformer.from_crs(GEOGRAPHIC, crs).transform(*at)[:2]
    same = EarthPlace(crs, np.array([x, y, at[2]]), EAST_DOWN_NORTH)  # of a file in that grid
    assert in_grid(crs, same) == [(code, message)]


@pytest.mark.parametrize(
    ("crs", "at"),
    [
        ("EPSG:25832", (47.4, 8.5, 408)),
        ("EPSG:2193", (-41.3, 174.8, 0)),
        ("EPSG:5514", (50.08, 14.43, 250)),
        ("EPSG:2056", (46.9, 7.4, 500)),
        ("EPSG:2154", (51.0, 2.0, 0)),
    ],
)
def test_a_grid_of_the_region_is_no_warning(crs: str, at: tuple[int, ...]) -> None:
    pytest.importorskip("pyproj")
    assert in_grid(crs, EarthPlace(GEOGRAPHIC, np.array(at, np.float64), EAST_DOWN_NORTH)) == []


def test_a_file_in_a_stretched_grid_is_no_warning_for_another_grid() -> None:
    pyproj = pytest.importorskip("pyproj")
    x, y = pyproj.Transformer.from_crs(GEOGRAPHIC, "EPSG:3857").transform(47.4, 8.5, 0)[:2]
    assert (
        in_grid("EPSG:25832", EarthPlace("EPSG:3857", np.array([x, y, 0]), EAST_DOWN_NORTH)) == []
    )


def test_a_grid_of_another_region_is_a_warning_or_an_error() -> None:
    pytest.importorskip("pyproj")
    report = Report()
    in_crs(EarthPlace(GEOGRAPHIC, HOME, np.eye(3)), "EPSG:25833", report)
    ((code, message),) = report.warnings
    assert code == "sfm-crs-outside"
    assert "47.3769, 8.5417" in message
    with pytest.raises(SplatError) as raised:
        in_crs(EarthPlace(GEOGRAPHIC, np.array([0.0, 99.0, 0.0]), np.eye(3)), "EPSG:25832", report)
    assert raised.value.code == "crs-elsewhere"


@pytest.mark.parametrize(
    ("crs", "code"),
    [
        ("EPSG:99999", "crs-unknown"),
        ("EPSG:4326", "crs-not-projected"),
        ("EPSG:4978", "crs-not-projected"),
        ("EPSG:2263", "crs-not-projected"),  # New York, in feet
        ("EPSG:5555", "crs-not-projected"),  # with heights of its own
    ],
)
def test_a_system_that_is_no_grid_in_metres_is_refused(crs: str, code: str) -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(SplatError) as raised:
        projected_system(crs)
    assert (raised.value.code, raised.value.family) == (code, Family.USAGE)
    assert crs in raised.value.given


def test_without_pyproj_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(SplatError) as raised:
        projected_system("EPSG:25832")
    assert raised.value.code == "crs-needs-pyproj"
    assert 'pip install "splatcli[geo]"' in raised.value.hint


def test_a_grid_for_a_scene_without_place_is_a_warning() -> None:
    local = flight()
    photos = [replace(photo, gps=None) for photo in photographs(on_earth(local))]
    known = KnownScale(metres=True, crs="EPSG:25832")
    _, report = placed(photos, world_of(local), known)
    assert [code for code, _ in report.warnings] == ["sfm-crs-unused"]


def test_a_grid_beside_a_given_size_is_not_used_for_that_size() -> None:
    local = flight()
    known = KnownScale(("0.jpg", "1.jpg", "3"), crs="EPSG:25832")
    _, report = placed(photographs(on_earth(local)), world_of(local), known)
    ((code, text),) = report.warnings
    assert code == "sfm-crs-unused"
    assert "--scale gives the size of the scene, and GPS is not used beside it" in text
