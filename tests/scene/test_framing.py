"""Where a scene without photographs is looked at from: inside its room, at what is in it."""

from __future__ import annotations

import numpy as np
import pytest

from stages.raster.draw import render
from stages.scene import Camera, Splats
from stages.scene.framing import front_camera, median_depth, orbit_cameras
from tests import scenes

HALF_ROOM = np.array([6.0, 2.5, 5.0])


def ball(count: int, seed: int = 1) -> np.ndarray:
    points = np.random.default_rng(seed).normal(0, 1, (count, 3))
    return 0.5 * points / np.linalg.norm(points, axis=1, keepdims=True)


def room(per_wall: int = 700) -> np.ndarray:
    generator = np.random.default_rng(2)
    walls = []
    for axis in range(3):
        for side in (-1, 1):
            wall = generator.uniform(-1, 1, (per_wall, 3)) * HALF_ROOM
            wall[:, axis] = side * HALF_ROOM[axis]
            walls.append(wall)
    return np.concatenate(walls)


def joined(*parts: tuple[np.ndarray, float, tuple[float, float, float]]) -> Splats:
    return scenes.join(
        *(scenes.splats(means, size, 0.95, [rgb] * len(means)) for means, size, rgb in parts)
    )


@pytest.mark.parametrize("scale", [0.01, 1.0, 500.0])
def test_an_object_in_a_room_is_seen_from_inside_the_room(scale: float) -> None:
    middle = np.array([1.5, 1.0, -1.0])
    scene = joined(
        ((ball(6000) + middle) * scale, 0.02 * scale, (1.0, 0.1, 0.1)),
        (room() * scale, 0.15 * scale, (0.1, 0.1, 1.0)),
    )
    camera = front_camera(scene)
    assert (np.abs(camera.centre) < HALF_ROOM * scale).all()
    assert camera.centre[1] < middle[1] * scale  # from above, y is down
    image = render(scene, camera).image
    middle_of_picture = image[320:400, 440:520].mean((0, 1))
    assert middle_of_picture[0] > 3 * middle_of_picture[2]


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1.0, 1e4])
def test_where_a_scene_is_looked_at_from_scales_with_it(scale: float) -> None:
    def scaled(factor: float) -> tuple[Splats, Camera]:
        scene = joined((ball(3000) * factor, 0.02 * factor, (1.0, 0.1, 0.1)))
        return scene, front_camera(scene)

    (scene, camera), (one, at_one) = scaled(scale), scaled(1.0)
    np.testing.assert_allclose(camera.centre / scale, at_one.centre, rtol=1e-4, atol=1e-6)
    depth = median_depth(camera, scene.means) / scale
    assert depth == pytest.approx(median_depth(at_one, one.means), rel=1e-4)
    turn, at_turn = (orbit_cameras(each, 4, 0.9) for each in (scene, one))
    np.testing.assert_allclose(turn[1].centre / scale, at_turn[1].centre, rtol=1e-4, atol=1e-6)


def test_a_pillar_before_the_object_is_looked_past() -> None:
    pillar = np.random.default_rng(3).uniform(-1, 1, (900, 3)) * (0.3, 2, 0.1) + (0, 0, -0.9)
    scene = joined((ball(6000), 0.02, (1.0, 0.1, 0.1)), (pillar, 0.1, (0.1, 0.1, 1.0)))
    image = render(scene, front_camera(scene)).image
    assert image[340:380, 460:500].mean((0, 1))[0] > 0.5


def test_an_object_alone_is_seen_whole_from_in_front() -> None:
    scene = joined((ball(4000), 0.02, (1.0, 0.1, 0.1)))
    camera = front_camera(scene)
    pixels, z = camera.project(scene.means)
    assert camera.shows(pixels).all()
    assert (z > 0).all()
    assert camera.centre[2] < -0.8


def test_splats_that_cannot_be_drawn_do_not_decide() -> None:
    scene = joined((ball(100), 0.02, (1.0, 0.1, 0.1)))
    scene.means[:20] = np.nan
    scene.log_scales[20:30] = 1e30
    assert np.isfinite(front_camera(scene).world_to_camera).all()
    assert np.isfinite(front_camera(scene[:0]).world_to_camera).all()


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.1, 100.0])
def test_splats_in_one_place_are_seen_from_outside_of_them(sigma: float, count: int) -> None:
    middle = np.array([1.0, 2.0, 3.0])
    scene = joined((np.tile(middle, (count, 1)), sigma, (1.0, 0.9, 0.8)))
    for camera in (front_camera(scene), *orbit_cameras(scene, 3, 0.5)):
        assert 3 <= np.linalg.norm(camera.centre - middle) / sigma < 30
        image = render(scene, camera).image[..., 0]
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert image[image.shape[0] // 2, image.shape[1] // 2] > 0.8
        assert border.mean() < 0.2
