"""Fewer splats: what is kept of each pair, and of the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.editing.decimate import Moments, decimate, merge
from stages.evaluate.image_metrics import capped_psnr_db
from stages.raster.definition import ALPHA_MAX
from stages.raster.draw import render
from stages.scene import Camera, Splats, look_at
from tests import scenes
from tests.editing.walls import wall


def from_afar(distance: float) -> Camera:
    eye = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0]) * distance
    return Camera(160, 160, 160, 160, 80, 80, look_at(eye, np.zeros(3)))


def moments(splats: Splats) -> Moments:
    return Moments.of(splats, np.arange(len(splats)))


def test_a_pair_keeps_its_mass_its_mean_and_its_covariance() -> None:
    pair = scenes.splats([[0, 0, 0], [5, 0, 0]], [[0.1, 0.2, 0.3], [0.3, 0.3, 0.1]], [0.2, 0.4])
    a, b = moments(pair.take(slice(1))), moments(pair.take(slice(1, 2)))
    found, share = merge(a, b)
    weights = np.array([share[0], 1 - share[0]])
    draws = np.random.default_rng(0).normal(size=(2, 200_000, 3))
    points = [draws[i] * np.exp(pair.log_scales[i]) + pair.means[i] for i in (0, 1)]
    both = np.concatenate([points[0], points[1]])
    count = np.repeat(weights / 200_000, 200_000)
    mean = count @ both
    spread = (both - mean).T @ ((both - mean) * count[:, None])
    np.testing.assert_allclose(found.means[0], mean, atol=0.01)
    upper = spread[np.triu_indices(3)]
    np.testing.assert_allclose(found.covariances[0], upper, atol=0.02)
    np.testing.assert_allclose(found.masses, a.masses + b.masses)


def test_two_equal_splats_on_one_place_cover_less_than_twice_as_much() -> None:
    one = moments(scenes.splats([[0, 0, 0]], 0.1, 0.3))
    found, share = merge(one, one)
    assert share[0] == 0.5
    np.testing.assert_allclose(found.covariances, one.covariances)
    # 1 - (1 - g)^2 of a Gaussian g of height p has the mass 2 p - p p / 2
    np.testing.assert_allclose(found.opacities, 2 * 0.3 - 0.3**2 / 2)


def test_mass_that_no_opacity_can_hold_makes_a_splat_larger() -> None:
    pair = moments(scenes.splats([[0, 0, 0], [0.25, 0, 0]], 0.1, 0.95))
    found, _ = merge(pair.take(slice(1)), pair.take(slice(1, 2)))
    assert found.opacities[0] == ALPHA_MAX
    assert found.masses[0] > 1.7 * pair.masses[0]


def test_shapes_come_back_from_their_covariances() -> None:
    splats = scenes.cloud(50)
    found = moments(splats)
    quaternions, logs = found.shapes()
    again = replace(splats, quaternions=quaternions, log_scales=logs)
    np.testing.assert_allclose(moments(again).covariances, found.covariances, rtol=1e-6, atol=1e-9)
    flat = scenes.splats([[0, 0, 0]], [0.1, 0.1, 1e-30])
    assert np.isfinite(moments(flat).shapes()[1]).all()


@pytest.mark.parametrize("count", [1, 7, 250, 999, 1000, 5000])
def test_there_are_as_many_as_were_asked_for(count: int) -> None:
    found = decimate(wall(1000), count)
    assert len(found) == min(count, 1000)
    assert all(np.isfinite(array).all() for array in found.arrays)


def test_splats_that_are_all_the_same_become_fewer_too() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(12.0)] * 3), -1).reshape(-1, 3)
    assert len(decimate(scenes.splats(grid), 100)) == 100
    assert len(decimate(scenes.splats(np.zeros((500, 3))), 3)) == 3


def test_from_afar_a_tenth_of_the_splats_shows_the_same() -> None:
    full = wall(4000)
    few = decimate(full, 400)
    camera = from_afar(20)
    picture = render(full, camera).image
    assert picture.max() > 0.3
    assert capped_psnr_db(render(few, camera).image, np.clip(picture, 0, 1)) > 40
    left_out = full.take(np.arange(0, 4000, 10))
    assert capped_psnr_db(render(left_out, camera).image, np.clip(picture, 0, 1)) < 30


def test_colours_that_differ_are_merged_last() -> None:
    r = np.random.default_rng(1)
    means = r.uniform(-1, 1, (600, 3))
    rgb = np.where(means[:, :1] > 0, (1.0, 0, 0), (0, 0, 1.0))
    found = decimate(scenes.splats(means, 0.05, 0.5, rgb), 60)
    colours = 0.5 + 0.28209479 * found.sh[:, 0]
    pure = np.minimum(np.abs(colours - (1, 0, 0)).max(1), np.abs(colours - (0, 0, 1)).max(1))
    assert (pure < 1e-3).mean() > 0.9
