"""How large the world is, and where north."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.ingest.exif import read_exif
from stages.scene import Camera, Capture, Photo, look_at
from stages.sfm.place.gps import MetricScale, about_vertical
from stages.sfm.place.metric_scale import KnownScale, find_metric_scale
from tests.sfm.checks.bad_captures import SAMPLE

METRES = 7.0  # of one unit of the made worlds
TURN = 0.8  # radians, clockwise from above, from north to the worlds' +Z
HOME = (47.3769, 8.5417)


def cameras(count: int = 12, seed: int = 0) -> np.ndarray:
    """[V, 4, 4] looking at the middle from around it, y down."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 5, count)
    eyes = np.stack([np.cos(angles), -0.4 + 0 * angles, np.sin(angles)], axis=1)
    return np.array([look_at(eye + rng.normal(0, 0.1, 3), np.zeros(3)) for eye in eyes])


def centres(poses: np.ndarray) -> np.ndarray:
    return -np.einsum("vij,vi->vj", poses[:, :3, :3], poses[:, :3, 3])


def capture_of(places: list[tuple[float, float] | None]) -> Capture:
    photos = tuple(
        Photo(f"{i}.jpg", f"photos/{i}.jpg", 640, 480, None, "c", 3.0, -2.0, None, gps=place)
        for i, place in enumerate(places)
    )
    return Capture(SAMPLE, photos)


def true_east_north(poses: np.ndarray) -> np.ndarray:
    """Where the made worlds' cameras are on Earth, metres from their middle."""
    x, z = centres(poses)[:, 0], centres(poses)[:, 2]
    c, s = np.cos(TURN), np.sin(TURN)
    return METRES * np.stack([c * x + s * z, c * z - s * x], axis=1)


def on_earth(metres: np.ndarray) -> list[tuple[float, float] | None]:
    """Latitude and longitude, by the lengths of a degree at that latitude (NIMA TR8350.2)."""
    return [
        (HOME[0] + north / 111_182.0, HOME[1] + east / 75_503.0) for east, north in metres.tolist()
    ]


def found(capture: Capture, poses: np.ndarray, *distance: str, levelled: bool = True):
    report = Report()
    posed = [Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose) for pose in poses]
    return find_metric_scale(
        KnownScale(distance), capture.photos, posed, [], levelled, report
    ), report


def test_a_distance_between_two_photographs_makes_the_world_metric() -> None:
    poses = cameras()
    metric, report = found(capture_of([None] * 12), poses, "2.jpg", "9.jpg", "3.5")
    assert metric is not None
    moved = centres(metric.poses(poses))
    assert np.linalg.norm(moved[2] - moved[9]) == pytest.approx(3.5)
    assert "3.5 m apart" in report.metrics["scale_source"]


def test_a_marker_beside_a_distance_is_said_to_be_unused() -> None:
    report = Report()
    posed = [Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose) for pose in cameras()]
    known = KnownScale(("2.jpg", "9.jpg", "3.5"), marker=0.05)
    photos = capture_of([None] * 12).photos
    metric = find_metric_scale(known, photos, posed, [], True, report)
    assert metric is not None
    assert "3.5 m apart" in metric.source
    assert [code for code, _ in report.warnings] == ["sfm-marker-unused"]


def test_markers_that_are_not_found_are_an_error_of_the_photographs() -> None:
    """So the run forgets `--marker`, and the next command goes on without it."""
    posed = [Camera(640, 480, 600.0, 600.0, 320.0, 240.0, pose) for pose in cameras()]
    photos = capture_of([None] * 12).photos
    with pytest.raises(SplatError) as raised:
        find_metric_scale(KnownScale(marker=0.05), photos, posed, [], True, Report())
    assert (raised.value.code, raised.value.family) == ("sfm-marker", Family.INPUT)


def test_points_move_with_the_cameras() -> None:
    poses, metric = cameras(), MetricScale(3.0, "", about_vertical(0.5))
    points = np.random.default_rng(1).normal(size=(20, 3))
    for before, after in zip(poses, metric.poses(poses), strict=True):
        seen = points @ before[:3, :3].T + before[:3, 3]
        again = metric.points(points) @ after[:3, :3].T + after[:3, 3]
        assert again == pytest.approx(3.0 * seen)


@pytest.mark.parametrize(
    "distance",
    [
        ("1.jpg", "2.jpg", "far"), ("1.jpg", "2.jpg", "-1"), ("1.jpg", "2.jpg", "nan"),
        ("1.jpg", "1.jpg", "1"), ("1.jpg", "other.jpg", "1"),
    ],
)  # fmt: skip
def test_a_distance_that_cannot_be_used_is_an_error(distance: tuple[str, str, str]) -> None:
    with pytest.raises(SplatError) as raised:
        found(capture_of([None] * 12), cameras(), *distance)
    assert raised.value.code == "sfm-scale"


def test_gps_makes_the_world_metric_and_north_the_z_axis() -> None:
    poses = cameras()
    metric, report = found(capture_of(on_earth(true_east_north(poses))), poses)
    assert metric is not None
    assert metric.metres == pytest.approx(METRES, rel=1e-3)
    moved = centres(metric.poses(poses))
    truth = true_east_north(poses)
    assert moved[:, [0, 2]] - moved[0, [0, 2]] == pytest.approx(truth - truth[0], abs=0.02)
    assert report.metrics["gps_residual_m"] < 0.02


def test_gps_with_noise_and_wild_fixes_is_used_with_its_residual() -> None:
    poses = cameras(40)
    rng = np.random.default_rng(2)
    measured = true_east_north(poses) + rng.normal(0, 0.3, (40, 2))
    measured[::5] += rng.normal(0, 60, (8, 2))
    metric, report = found(capture_of(on_earth(measured)), poses)
    assert metric is not None
    assert metric.metres == pytest.approx(METRES, rel=0.05)
    assert 0.1 < report.metrics["gps_residual_m"] < 0.8
    assert 28 <= report.metrics["gps_agreeing"] <= 33


@pytest.mark.parametrize("count", [5, 6, 7, 8])
def test_few_positions_that_agree_are_used(count: int) -> None:
    """Two of them fit exactly, whichever two the hypothesis takes."""
    poses = cameras(count)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        measured = true_east_north(poses) * 3.0 + rng.normal(0, 0.02, (count, 2))
        metric, report = found(capture_of(on_earth(measured)), poses)
        assert metric is not None
        assert metric.metres == pytest.approx(3.0 * METRES, rel=0.02)
        assert report.metrics["gps_agreeing"] == count


def test_positions_off_by_less_than_allowed_agree_and_do_not_bend_the_scale() -> None:
    """As of positions to the centimetre, of which some were taken before the receiver was."""
    poses = cameras(12)
    measured = 100.0 * true_east_north(poses)
    spread = np.sqrt(np.mean(np.sum((measured - measured.mean(axis=0)) ** 2, axis=1)))
    measured[:3] += 0.1 * spread * np.array([[1, 0], [0, -1], [-1, 0]])
    metric, report = found(capture_of(on_earth(measured)), poses)
    assert metric is not None
    assert metric.metres == pytest.approx(100.0 * METRES, rel=1e-3)
    assert report.metrics["gps_agreeing"] == 12


def test_gps_that_does_not_fit_is_refused() -> None:
    """As of a table-top scene: the receiver strays farther than the photographer walked."""
    rng = np.random.default_rng(3)
    capture = capture_of(on_earth(rng.normal(0, 4, (12, 2))))
    metric, report = found(capture, cameras())
    assert metric is None
    assert report.metrics["scale_source"] == "nothing"
    assert report.metrics["with_gps"] == 12
    assert report.metrics["gps_unused"]
    assert not report.warnings  # spread no farther than a receiver errs


@pytest.mark.parametrize(
    ("errors_m", "wrong", "fixes", "levelled", "why"),
    [
        (0, 0, 4, True, "5 photographs are needed"),
        (0, 0, 12, False, "the up direction was not found"),
        (400, 5, 12, True, "only 7 of them agree with the cameras"),
        (15, 12, 12, True, "they differ from the cameras by"),
    ],
)
def test_gps_that_is_not_used_is_reported_with_the_reason(
    errors_m: float, wrong: int, fixes: int, levelled: bool, why: str
) -> None:
    poses, rng = cameras(), np.random.default_rng(5)
    metres = 10.0 * true_east_north(poses)
    metres[:wrong] += rng.uniform(-1, 1, (wrong, 2)) * errors_m
    places = on_earth(metres)
    metric, report = found(
        capture_of([*places[:fixes], *[None] * (12 - fixes)]), poses, levelled=levelled
    )
    assert metric is None
    assert why in report.metrics["gps_unused"]
    ((code, message),) = report.warnings
    assert code == "sfm-gps-unused"
    assert f"{fixes} of 12 photographs have GPS" in message
    assert why in message


def test_gps_that_is_used_is_no_warning() -> None:
    poses = cameras()
    metric, report = found(capture_of(on_earth(10.0 * true_east_north(poses))), poses)
    assert metric is not None
    assert not report.warnings
    assert "gps_unused" not in report.metrics


def test_nothing_is_known_without_gps_a_distance_or_a_level() -> None:
    poses = cameras()
    assert found(capture_of([None] * 12), poses)[0] is None
    assert found(capture_of(on_earth(true_east_north(poses))), poses, levelled=False)[0] is None


class Tags(dict):
    """EXIF as Pillow gives it."""

    def get_ifd(self, number: int) -> dict:
        return self.get(number, {}) if number == 0x8825 else {}


@pytest.mark.parametrize(
    ("tags", "place"),
    [
        ({1: "N", 2: (47, 30, 36), 3: "W", 4: (8, 0, 0)}, (47.51, -8.0)),
        ({1: "S", 2: (33.5, 0, 0), 3: "E", 4: (151, 12, 0)}, (-33.5, 151.2)),
        ({1: "N", 2: (0, 0, 0), 3: "E", 4: (0, 0, 0)}, None),
        ({1: "N", 2: (95, 0, 0), 3: "E", 4: (0, 0, 0)}, None),
        ({1: "N", 2: (47, 0), 3: "E", 4: (8, 0, 0)}, None),
        ({2: (47, 0, 0), 4: (8, 0, 0)}, None),
        ({1: "N", 2: float("nan"), 3: "E", 4: (8, 0, 0)}, None),
    ],
)
def test_gps_is_read_from_exif(tags: dict, place: tuple[float, float] | None) -> None:
    class Picture:
        def getexif(self) -> Tags:
            return Tags({0x8825: tags})

    assert read_exif(Picture()).gps.position == place
