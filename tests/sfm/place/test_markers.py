"""Printed markers of a stated size make the world metric."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.scene import Camera, look_at
from stages.sfm.place.markers import marker_sides
from stages.sfm.place.metric_scale import KnownScale, find_metric_scale

SIDE = 0.37  # of a marker, world units
EYES = np.array([[0.8, -2.0, -1.0], [-0.9, -1.8, -1.2], [0.1, -2.4, 0.9]])


def cameras() -> list[Camera]:
    return [
        Camera(960, 720, 900.0, 900.0, 470.0, 365.0, look_at(eye, np.array([0.5, 0, 0.4])))
        for eye in EYES
    ]


def sheet(kind: str) -> tuple[np.ndarray, float]:
    """(a printed sheet [H, W], world units a pixel of it)."""
    if kind == "board":
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        board: Any = cv2.aruco.CharucoBoard((4, 3), 1.0, 0.7, words)
        return board.generateImage((800, 600), marginSize=0), SIDE / 140
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)
    page = np.full((600, 800), 255, np.uint8)
    for number, (x, y) in enumerate([(60, 60), (500, 80), (260, 330)]):
        page[y : y + 180, x : x + 180] = cv2.aruco.generateImageMarker(words, number, 180)
    return page, SIDE / 180


def photographs(folder: Path, kind: str = "alone", blank: bool = False) -> list[Path]:
    """The sheet on the ground (y = 0), as each camera sees it."""
    page, unit = sheet(kind)
    if blank:
        page = np.full_like(page, 200)
    paths = []
    for number, camera in enumerate(cameras()):
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pose = camera.world_to_camera
        # Pixel centres of page and picture lie half a pixel from OpenCV's whole numbers. Seen from
        # above (y points down), x goes right and z up: the page's rows go down.
        from_page = np.array([[unit, 0, unit / 2], [0, 0, 0], [0, -unit, 600 * unit - unit / 2]])
        to_camera = matrix @ (pose[:3, :3] @ from_page + np.outer(pose[:3, 3], [0, 0, 1]))
        to_camera = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ to_camera
        shown = cv2.warpPerspective(page, to_camera, (960, 720), borderValue=(150,))
        paths.append(folder / f"{number}.png")
        cv2.imwrite(str(paths[-1]), cv2.GaussianBlur(shown, (0, 0), 0.7))
    return paths


@pytest.mark.parametrize("kind", ["alone", "board"])
def test_sides_of_markers_are_measured(tmp_path: Path, kind: str) -> None:
    sides = marker_sides(photographs(tmp_path, kind), cameras())
    assert len(sides) >= 12
    assert np.median(sides) == pytest.approx(SIDE, rel=0.005)
    assert np.abs(sides / SIDE - 1).max() < 0.02


def poses() -> list[np.ndarray]:
    places = [((-0.5, 0.0, 0.0), 0.25), ((0.5, 0.0, 0.0), -0.25), ((0.0, 0.3, 0.0), 0.0)]
    found = []
    for centre, yaw in places:
        pose = np.eye(4)
        pose[0, ::2], pose[2, ::2] = (np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))
        pose[:3, 3] = -pose[:3, :3] @ centre
        found.append(pose)
    return found


def exact_picture(camera: Camera, side: float, sub: int = 8) -> np.ndarray:
    """A marker in the plane z = 2: the mean of sub x sub points of each pixel."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)
    cells = cv2.aruco.generateImageMarker(words, 7, 8)
    at = [(np.arange(n * sub) + 0.5) / sub for n in (camera.width, camera.height)]
    x, y = np.meshgrid((at[0] - camera.cx) / camera.fx, (at[1] - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.world_to_camera[:3, :3]
    centre = camera.centre
    on_plane = centre[:2] + rays[..., :2] * ((2 - centre[2]) / rays[..., 2])[..., None]
    column, row = np.moveaxis(np.floor((on_plane / side + 0.5) * 8).astype(int), -1, 0)
    far = np.maximum(np.abs(column - 3.5), np.abs(row - 3.5))
    shown = np.where(far < 4, cells[np.clip(row, 0, 7), np.clip(column, 0, 7)], 255)
    shown = np.where(far < 6, shown, 128).astype(np.float32)
    return cv2.resize(shown, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("pixels", [90, 45])
@pytest.mark.parametrize("blur", [0, 1])
def test_sides_are_not_too_short_in_small_or_blurred_pictures(
    tmp_path: Path, pixels: int, blur: int
) -> None:
    side = pixels * 2.06 / 900
    seen = [Camera(240, 240, 900.0, 900.0, 120.0, 120.0, pose) for pose in poses()]
    paths = [tmp_path / f"{number}.png" for number in range(len(seen))]
    for path, camera in zip(paths, seen, strict=True):
        shown = exact_picture(camera, side)
        shown = cv2.GaussianBlur(shown, (0, 0), blur) if blur else shown
        cv2.imwrite(str(path), shown.round().astype(np.uint8))
    sides = marker_sides(paths, seen)
    assert len(sides) == 4
    assert abs(np.median(sides) / side - 1) < 0.005


def test_a_side_that_is_covered_in_part_is_measured(tmp_path: Path) -> None:
    side = 90 * 2.06 / 900
    seen = [Camera(240, 240, 900.0, 900.0, 120.0, 120.0, pose) for pose in poses()]
    paths = [tmp_path / f"{number}.png" for number in range(len(seen))]
    for path, camera in zip(paths, seen, strict=True):
        corners, _ = camera.project(np.array([[-0.5, -0.5, 0], [0.5, 0.5, 0]]) * side + (0, 0, 2))
        shown = exact_picture(camera, side)
        # A grey strip hides a third of one side: its line comes from the other two thirds.
        left, right = corners[0, 0], corners[1, 0]
        middle = slice(int(left + (right - left) * 0.4), int(left + (right - left) * 0.7))
        top = int(corners[0, 1])
        shown[top - 6 : top + 4, middle] = 90
        cv2.imwrite(str(path), shown.round().astype(np.uint8))
    sides = marker_sides(paths, seen)
    assert len(sides) == 4
    assert np.abs(sides / side - 1).max() < 0.01


def test_markers_of_a_stated_size_make_the_world_metric(tmp_path: Path) -> None:
    report = Report()
    pictures = photographs(tmp_path)
    metric = find_metric_scale(KnownScale(marker=0.05), (), cameras(), pictures, True, report)
    assert metric is not None
    assert metric.metres == pytest.approx(0.05 / SIDE, rel=0.005)
    assert report.metrics["markers"] == 3
    assert "markers of 0.05 m" in report.metrics["scale_source"]


def test_markers_that_are_not_there_are_an_error(tmp_path: Path) -> None:
    pictures = photographs(tmp_path, blank=True)
    assert len(marker_sides(pictures, cameras())) == 0
    with pytest.raises(SplatError, match="no ArUco marker"):
        find_metric_scale(KnownScale(marker=0.05), (), cameras(), pictures, True, Report())


def test_cameras_that_are_wrong_measure_no_marker(tmp_path: Path) -> None:
    pictures = photographs(tmp_path)
    assert len(marker_sides(pictures, cameras()[::-1])) == 0
