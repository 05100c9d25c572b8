"""Plane sweep: points lie on surfaces with texture."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.seed.plane_sweep import plane_sweep_points
from tests.seed.wall_and_plate import HALF, PLATE, WALL, capture, texture


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("sweep")
    views, points = capture(folder)
    return folder, views, points, *plane_sweep_points(folder, views, points)


def test_points_lie_on_the_surfaces(found) -> None:
    _, _, points, more, _ = found
    on_plate = (np.abs(more[:, 2] / PLATE - 1) < 0.03) & (np.abs(more[:, :2]).max(1) < 1.1 * HALF)
    on_wall = np.abs(more[:, 2] / WALL - 1) < 0.03
    assert len(more) > 5 * len(points)
    assert on_plate.sum() > 200
    assert (on_plate | on_wall).mean() > 0.98


def test_points_have_the_colour_of_their_pixel(found) -> None:
    _, _, _, more, colours = found
    wall = np.abs(more[:, 2] / WALL - 1) < 0.01
    where = ((more[wall, :2] + 5) / 10 * 768).astype(np.float32)
    wanted = cv2.remap(texture(1), where[:, :1], where[:, 1:], cv2.INTER_LINEAR)[:, 0] / 255
    assert np.median(np.abs(colours[wall] - wanted)) < 0.05


def test_nothing_more_is_found_where_points_already_are(found) -> None:
    folder, views, points, more, _ = found
    again, _ = plane_sweep_points(folder, views, np.concatenate([points, more]))
    assert len(again) < 0.1 * len(more)


def test_the_order_of_the_photographs_decides_nothing(found) -> None:
    folder, views, points, more, colours = found
    again, again_colours = plane_sweep_points(folder, views[::-1], points)
    assert again.tobytes() == more.tobytes()
    assert again_colours.tobytes() == colours.tobytes()


@pytest.mark.parametrize("unit", [2.0**-24, 2.0**24])
def test_the_unit_of_the_world_decides_nothing(found, unit: float) -> None:
    folder, views, points, more, _ = found
    scaled = []
    for view in views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] *= unit
        scaled.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    again, _ = plane_sweep_points(folder, tuple(scaled), points * unit)
    assert len(again) == len(more)
    np.testing.assert_allclose(again / unit, more, rtol=1e-6)


def test_plain_surfaces_give_no_points(tmp_path: Path) -> None:
    views, points = capture(tmp_path, plain=True)
    flat_wall = plane_sweep_points(tmp_path, views, points)[0]
    inside = np.abs(flat_wall[:, :2]).max(1) > 1.5 * HALF  # away from the plate's edge
    assert not inside.any()


@pytest.mark.parametrize("number", [0, 1, 2])
def test_too_few_photographs_give_no_points(tmp_path: Path, number: int) -> None:
    views, points = capture(tmp_path)
    more, colours = plane_sweep_points(tmp_path, views[:number], points)
    assert more.shape == (0, 3)
    assert colours.shape == (0, 3)


def test_without_measured_points_nothing_is_found(tmp_path: Path) -> None:
    views, _ = capture(tmp_path)
    assert len(plane_sweep_points(tmp_path, views, np.zeros((0, 3)))[0]) == 0
