"""Points for known cameras: from their file or from matches, and none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.cameras.camera_file import file_points
from stages.scene import Camera, look_at
from stages.sfm.known.points import count_views, find_points

EYES = [np.array([4 * np.sin(a), 0.0, 4 * np.cos(a)]) for a in np.linspace(0, 6, 8)]
CAMERAS = [Camera(80, 60, 90.0, 90.0, 40.0, 30.0, look_at(eye, np.zeros(3))) for eye in EYES]
CLOUD = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))


def triangulated(folder: Path, count: int) -> Path:
    views = np.arange(count, dtype=np.int32) % 8
    np.savez(
        folder / "points.npz",
        points=CLOUD[:count],
        colours=np.zeros((count, 3), np.uint8),
        errors_px=np.zeros(count),
        observed_points=np.arange(count, dtype=np.int32),
        observing_views=views,
        observed_px=np.zeros((count, 2)),
    )
    return folder / "points.npz"


def test_points_of_the_file_come_first(tmp_path: Path) -> None:
    report = Report()
    found, observed = find_points(file_points(CLOUD), triangulated(tmp_path, 99), CAMERAS, report)
    assert report.metrics["points_source"] == "camera file"
    np.testing.assert_array_equal(found.points, CLOUD)
    assert (found.tracks == count_views(CAMERAS, CLOUD)).all()
    assert not len(observed.points)


def test_points_elsewhere_are_not_used_and_said(tmp_path: Path) -> None:
    report = Report()
    away = file_points(CLOUD + 100)
    found, _ = find_points(away, triangulated(tmp_path, 99), CAMERAS, report)
    assert report.metrics["points_source"] == "triangulation"
    assert len(found.points) == 99
    assert [code for code, _ in report.warnings] == ["cameras-points-elsewhere"]


def test_without_points_the_cameras_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatError) as caught:
        find_points(None, triangulated(tmp_path, 0), CAMERAS, Report())
    assert caught.value.code == "cameras-no-points"
