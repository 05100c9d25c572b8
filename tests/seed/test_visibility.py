"""Visibility constraints: which positions other photographs support or contradict."""

import numpy as np

from stages.scene import Camera, View, look_at
from stages.seed.visibility import VisibilityConstraints

WALL = 6.0


def views() -> tuple[View, ...]:
    """Two cameras side by side that look at a wall, and one that looks away from it."""
    made = []
    for number, (x, towards) in enumerate([(-0.5, WALL), (0.5, WALL), (0.0, -WALL)]):
        matrix = look_at(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, towards]))
        made.append(View(str(number), f"{number}.png", Camera(80, 60, 80, 80, 40, 30, matrix)))
    return tuple(made)


def wall() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-2, 2, 17))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL)], 1)


def votes(position: tuple[float, float, float], of: str) -> tuple[int, int]:
    agree, before = VisibilityConstraints(views(), wall()).count(np.array([position]), of)
    return int(agree[0]), int(before[0])


def test_a_position_on_the_wall_is_supported() -> None:
    assert votes((0.1, 0.2, WALL), of="") == (2, 0)


def test_a_position_in_front_of_the_wall_is_contradicted() -> None:
    assert votes((0.1, 0.2, 0.5 * WALL), of="") == (0, 2)


def test_a_position_behind_the_wall_is_neither() -> None:
    assert votes((0.1, 0.2, 2 * WALL), of="") == (0, 0)


def test_a_photograph_does_not_support_itself() -> None:
    assert votes((0.1, 0.2, WALL), of="0") == (1, 0)
    assert votes((0.1, 0.2, 0.5 * WALL), of="1") == (0, 1)


def test_without_points_there_is_no_support() -> None:
    agree, before = VisibilityConstraints(views(), np.zeros((0, 3))).count(wall(), "")
    assert not agree.any()
    assert not before.any()
