"""The near plane of splats that come without cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.evaluate.image_metrics import psnr
from stages.raster.draw import raster_settings_of, render
from stages.scene import Camera, Reconstruction, Splats, View, look_at
from stages.scene.draw_settings import near_plane, near_plane_of
from tests.scenes import join, splats

RNG = np.random.default_rng(5)
OBJECT = RNG.uniform(-0.5, 0.5, (980, 3))
CAMERA = Camera(96, 72, 90.0, 90.0, 48.0, 36.0, look_at(np.array([0.0, 0.0, -1.5]), np.zeros(3)))


@pytest.mark.parametrize("count", [24, 400, 1000])
def test_a_long_row_of_cameras_sees_what_is_before_it(count: int) -> None:
    """A street: photographs that overlap by 80 %, one unit before a facade."""
    step, width = 0.23, 0.23 * count
    views = []
    for number in range(count):
        pose = np.eye(4)
        pose[0, 3] = -number * step
        camera = Camera(80, 60, 69.0, 69.0, 40.0, 30.0, pose)
        views.append(View(f"{number:04}.jpg", "x", camera))
    points = RNG.uniform((0, -0.4, 0.9), (width, 0.4, 1.1), (60 * count, 3))
    colours, errors = np.zeros(points.shape, np.uint8), np.ones(len(points))
    lengths = np.full(len(points), 4, np.int32)
    row = Reconstruction(Path(), tuple(views), points, colours, errors, lengths)
    assert 0.1 < near_plane(row) < 0.3


def dome(radius: float, count: int = 30) -> np.ndarray:
    around = RNG.normal(size=(count, 3))
    return radius * around / np.linalg.norm(around, axis=1, keepdims=True)


def coloured(means: np.ndarray, size: float) -> Splats:
    return splats(means, scales=size, rgb=(0.8, 0.3, 0.1))


@pytest.mark.parametrize("radius", [1e2, 1e3, 1e5])
def test_a_sky_dome_does_not_hide_the_object(radius: float) -> None:
    """3 % of the splats; the same picture as with a near plane from cameras around the object."""
    scene = join(coloured(OBJECT, 0.02), coloured(dome(radius), 0.1 * radius))
    near = raster_settings_of(scene)
    wanted = render(scene, CAMERA, raster_settings_of(coloured(OBJECT, 0.02)), backend="cpu").image
    assert psnr(render(scene, CAMERA, near, backend="cpu").image, wanted) > 60


@pytest.mark.parametrize("count", [2, 3, 5, 10])
def test_one_outlier_among_few_splats_does_not_hide_the_others(count: int) -> None:
    means = np.concatenate([OBJECT[: count - 1], [[0.0, 0.0, 1e4]]])
    assert near_plane_of(means) < 0.02
    picture = render(coloured(means, 0.2), CAMERA, backend="cpu")
    assert picture.alpha.max() > 0.4


@pytest.mark.parametrize("factor", [1e-4, 1.0, 1e4])
def test_the_near_plane_grows_with_the_scene(factor: float) -> None:
    assert near_plane_of(factor * OBJECT) == pytest.approx(factor * near_plane_of(OBJECT))


def test_splats_that_are_not_finite_or_coincide_have_a_near_plane() -> None:
    assert near_plane_of(np.full((3, 3), np.nan)) > 0
    assert near_plane_of(np.ones((5, 3))) > 0
    damaged = np.concatenate([OBJECT, np.full((9, 3), np.inf)])
    assert near_plane_of(damaged) == near_plane_of(OBJECT)
