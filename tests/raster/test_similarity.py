"""Turned, scaled and moved splats look from a moved camera as they did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.raster.definition import RasterSettings
from stages.raster.reference import parameters_of, render_tensors
from stages.raster.similarity import Similarity, rotation_about, rotation_to_up
from stages.scene import DrawSettings, Splats
from tests import scenes

TURN = rotation_about(np.array([0.3, -1.0, 0.5]), 77.0)
SETTINGS = RasterSettings(near=0.1)


def exact(n: int, degree: int) -> Splats:
    """A cloud in float64."""
    splats = scenes.cloud(n, degree=degree)
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return replace(splats, **{name: getattr(splats, name).astype(np.float64) for name in names})


def drawn(splats: Splats, camera, settings: RasterSettings = SETTINGS) -> np.ndarray:
    found = render_tensors(parameters_of(splats, torch.float64), camera, settings)
    return (found[0] if isinstance(found, tuple) else found).detach().numpy()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "where",
    [
        Similarity(rotation=TURN),
        Similarity(3.0, TURN, np.array([4.0, -5.0, 6.0])),
        Similarity(0.2, TURN).after(Similarity(7.0, rotation_to_up(np.array([0.2, 0.1, 1.0])))),
    ],
    ids=["turned", "all three", "one after the other"],
)
def test_a_moved_camera_sees_of_moved_splats_what_it_saw(where: Similarity, degree: int) -> None:
    splats, camera = exact(40, degree), scenes.camera()
    settings = replace(SETTINGS, near=SETTINGS.near * where.scale)
    before = drawn(splats, camera)
    after = drawn(where.apply_to_splats(splats), where.apply_to_camera(camera), settings)
    assert before.std() > 0.05
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_colours_that_do_not_turn_with_the_splats_are_seen_to_be_wrong() -> None:
    splats, camera, where = exact(40, 3), scenes.camera(), Similarity(rotation=TURN)
    stuck = replace(where.apply_to_splats(splats), sh=splats.sh)
    assert np.abs(drawn(stuck, where.apply_to_camera(camera)) - drawn(splats, camera)).max() > 0.05


def test_a_half_turn_about_x_is_the_one_that_files_with_y_up_get() -> None:
    from stages.scene.flip import flipped

    splats = exact(20, 3)
    where = Similarity(rotation=rotation_about(np.array([1.0, 0, 0]), 180))
    np.testing.assert_allclose(where.apply_to_splats(splats).sh, flipped(splats).sh, atol=1e-12)
    np.testing.assert_allclose(
        where.apply_to_splats(splats).means, flipped(splats).means, atol=1e-12
    )


def test_the_origin_is_transformed_too() -> None:
    splats = replace(
        exact(5, 1), origin=np.array([100.0, 0, 0]), draw_settings=DrawSettings(near=0.5)
    )
    where = Similarity(2.0, rotation_about(np.array([0, 0, 1.0]), 90), np.array([1.0, 2, 3]))
    there = where.apply_to_splats(splats)
    world = (splats.means + splats.origin) @ (2 * where.rotation.T) + where.offset
    np.testing.assert_allclose(there.means + there.origin, world, atol=1e-12)
    assert there.draw_settings.near == 1.0


def test_splats_moved_far_away_keep_their_digits() -> None:
    splats = scenes.cloud(50)
    there = Similarity(offset=np.array([6e6, 0, 0])).apply_to_splats(splats)
    assert there.means.dtype == np.float32
    back = there.means.astype(np.float64) + there.origin - (6e6, 0, 0)
    np.testing.assert_allclose(back, splats.means, atol=1e-6)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0), (0.3, -0.2, 0.9)])
def test_what_was_up_is_minus_y_afterwards(up: tuple[float, float, float]) -> None:
    rotation = rotation_to_up(np.array(up, np.float64))
    np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), (0, -1, 0), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
