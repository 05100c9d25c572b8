"""The depth of what has no points, from the colours of other photographs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.scene import Camera, View, look_at
from stages.seed.colour_evidence import SmallPicture, depths_by_colour
from stages.seed.projection import pixel_centres

WIDTH, HEIGHT = 320, 240
WALL = 8.0  # z of a wall
BAND = 0.6  # half of the width of a red band on it
RED, GREY = (200, 40, 40), (120, 120, 120)
NOWHERE = np.zeros((0, 3))


def photograph(folder: Path, x: float, turned: bool = False) -> View:
    """Of the wall, from (x, 0, 0); `turned` away from it, it shows only grey."""
    name = f"{x}{turned}.png"
    at = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / 200.0 * WALL + x
    row = np.where((np.abs(at) < BAND)[:, None] & (not turned), RED, GREY).astype(np.uint8)
    Image.fromarray(np.broadcast_to(row, (HEIGHT, WIDTH, 3)).copy()).save(folder / name)
    matrix = look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, -1.0 if turned else 1.0]))
    return View(name, name, Camera(WIDTH, HEIGHT, 200.0, 200.0, 160.0, 120.0, matrix))


def pictures(folder: Path, places, points: np.ndarray = NOWHERE) -> list[SmallPicture]:
    return [SmallPicture.of(folder, photograph(folder, x), points) for x in places]


def depths(found: list[SmallPicture], near: float, first: float) -> np.ndarray:
    """Of the cells of the band's middle in the first photograph."""
    own = found[0]
    at = pixel_centres(np.arange(8, 16), np.full(8, own.camera.width // 2))
    return depths_by_colour(own, found[1:], at, np.full(8, near), np.full(8, first))


@pytest.mark.parametrize("first", [WALL / 4, WALL / 2, 2 * WALL, 4 * WALL])
def test_a_cell_moves_to_where_other_photographs_show_its_colour(
    tmp_path: Path, first: float
) -> None:
    found = depths(pictures(tmp_path, (0.0, -1.5, 1.5, 3.0)), 0.0, first)
    np.testing.assert_allclose(found, WALL, rtol=0.2)  # half of the step of sqrt(2) between depths


def test_what_nobody_contradicts_stays(tmp_path: Path) -> None:
    """Neither the colour at the place, nor that nobody else looks there, is a reason to move."""
    right = depths(pictures(tmp_path, (0.0, -1.5, 1.5)), 0.0, WALL)
    np.testing.assert_array_equal(right, WALL)
    away = [SmallPicture.of(tmp_path, photograph(tmp_path, x, True), NOWHERE) for x in (-1.5, 1.5)]
    unseen = depths([*pictures(tmp_path, (0.0,)), *away], 0.0, 3.0)
    np.testing.assert_array_equal(unseen, 3.0)
    np.testing.assert_array_equal(depths(pictures(tmp_path, (0.0,)), 0.0, 3.0), 3.0)


def test_no_cell_comes_nearer_than_its_least_depth(tmp_path: Path) -> None:
    found = depths(pictures(tmp_path, (0.0, -1.5, 1.5, 3.0)), 1.5 * WALL, 2 * WALL)
    assert found.min() >= 1.5 * WALL


def test_what_lies_behind_points_says_nothing_and_what_hides_them_contradicts(
    tmp_path: Path,
) -> None:
    random = np.random.default_rng(1)
    xy = random.uniform(-6, 6, (4000, 2))
    screen = np.c_[xy, np.full(len(xy), WALL)]
    (picture,) = pictures(tmp_path, (0.0,), screen)
    grey = (np.array([GREY]) / 255).astype(np.float32)
    assert picture.evidence(np.array([[2.0, 0.0, WALL]]), grey) == 1
    assert picture.evidence(np.array([[2.0, 0.0, 1.5 * WALL]]), grey) == 0
    assert picture.evidence(np.array([[1.0, 0.0, 0.5 * WALL]]), grey) < 0
    assert picture.evidence(np.array([[0.0, 0.0, -WALL]]), grey) == 0


def test_masked_cells_say_nothing(tmp_path: Path) -> None:
    (picture,) = pictures(tmp_path, (0.0,))
    masked = replace(picture, solid=np.zeros_like(picture.solid))
    red = (np.array([RED, RED]) / 255).astype(np.float32)
    at = np.array([[0.0, 0.0, WALL], [2.0, 0.0, WALL]])
    assert picture.evidence(at, red)[0] == 1
    assert picture.evidence(at, red)[1] < 0
    assert not masked.evidence(at, red).any()


def test_the_same_in_other_units_and_another_world(tmp_path: Path) -> None:
    """Depths follow the unit, and the axes of the world do not matter."""
    found = pictures(tmp_path, (0.0, -1.5, 1.5, 3.0))
    unit = 1e-3
    turn = look_at(np.array([0.3, -0.2, 0.9]), np.array([1.0, 0.4, 2.0]))
    moved = []
    for picture in found:
        matrix = picture.camera.world_to_camera @ np.linalg.inv(turn)
        matrix[:3, 3] *= unit
        moved.append(replace(picture, camera=replace(picture.camera, world_to_camera=matrix)))
    np.testing.assert_allclose(
        depths(moved, 0.0, unit * 3.0) / unit, depths(found, 0.0, 3.0), rtol=1e-6
    )


class Nothing:
    """A photograph that contradicts one depth and says nothing of others."""

    name = "nothing"

    def __init__(self, depth: float) -> None:
        self.depth = depth

    def evidence(self, positions: np.ndarray, _colours: np.ndarray) -> np.ndarray:
        return np.where(np.isclose(positions[:, 2], self.depth), -1, 0)


def test_of_equally_good_depths_a_farther_one_is_taken(tmp_path: Path) -> None:
    found = depths([*pictures(tmp_path, (0.0,)), Nothing(3.0)], 0.0, 3.0)  # type: ignore[list-item]
    assert (found > 3.0).all()


def test_what_every_depth_contradicts_alike_stays(tmp_path: Path) -> None:
    """Photographs from one place see all depths of a cell at one pixel."""
    own, other = pictures(tmp_path, (0.0, 0.0))
    other = replace(other, colours=np.zeros_like(other.colours))
    np.testing.assert_array_equal(depths([own, other], 0.0, 3.0), 3.0)
