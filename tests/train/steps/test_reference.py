"""The step that is written from its definitions, and the kernels' step, do the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.scene import IGNORE, TRANSPARENT, Splats
from stages.scene.light import Light
from stages.train.gauss_newton import GaussNewton
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, Model, new_model
from stages.train.steps.step import HostStep, StepInput, step_of
from stages.train.views import Level
from tests.scenes import camera, cloud

RATES = LearningRates(means=1e-3)


def level_of(scene: Splats) -> Level:
    where = camera(40, 30)
    picture = np.clip(render(scene, where).image, 0, 1)
    pixels = np.ascontiguousarray((picture * 255).round().astype(np.uint8).transpose(2, 0, 1))
    return Level(where, pixels, channel_means(pixels))


def masked(level: Level, outside: str) -> Level:
    """Hard and soft edges: a strip masked out, and half of what is left half there."""
    mask = np.full(level.pixels.shape[1:], 255, np.uint8)
    mask[:, 25:] = 130 if outside == TRANSPARENT else 255
    mask[8:19] = 0
    pixels = level.pixels
    if outside == TRANSPARENT:
        pixels = (pixels * (mask / 255)).astype(np.uint8)
    return replace(level, pixels=pixels, mask=mask, outside=outside)


def stepped(
    backend: str,
    steps: int,
    degree: int = 1,
    outside: str = "",
    light: Light | None = None,
    weight: float = 1.0,
    keys: tuple[int | None, ...] = (),
) -> tuple[Model, list[float]]:
    level = level_of(cloud(80, 40, 30, degree=1))
    if outside:
        level = masked(level, outside)
    level = replace(level, light=light)
    start = cloud(60, 40, 30, degree=1, seed=4)
    stepper = step_of(backend)
    model = new_model(*(array.copy() for array in splat_arrays(start)))
    model.distances[:] = np.linspace(0.1, 5.0, len(start))
    stepper.load(model)
    settings = RasterSettings(near=0.1, sh_degree=degree, background=(0.9, 0.2, 0.6))
    given = StepInput(level, settings, RATES, weight=weight)
    losses = [stepper.step(given) for _ in range(steps)]
    if keys:
        model.moment2[:] = 0.0
    for key in keys:
        losses.append(stepper.step(replace(given, gauss_newton=GaussNewton(300.0, key))))
    return stepper.model(), losses


@pytest.mark.parametrize("outside", ["", IGNORE, TRANSPARENT])
def test_gauss_newton_steps_are_those_of_the_definition(outside: str) -> None:
    keys = (1, 2, None, 3, None)
    kernels, losses = stepped("cpu", 1, 1, outside, weight=4.0, keys=keys)
    plain, wanted = stepped("reference", 1, 1, outside, weight=4.0, keys=keys)
    np.testing.assert_allclose(losses, wanted, rtol=1e-4)
    assert losses[-1] < losses[0]
    for name in ("moment1", "moment2", "means", "log_scales", "sh"):
        found, known = getattr(kernels, name), getattr(plain, name)
        np.testing.assert_allclose(found, known, atol=2e-3 * np.abs(known).max())
    np.testing.assert_array_equal(kernels.steps, plain.steps)


def test_what_a_mask_ignores_has_no_part_in_the_curvature() -> None:
    level = masked(level_of(cloud(80, 40, 30, degree=1)), IGNORE)
    given = StepInput(
        level, RasterSettings(), RATES, weight=4.0, gauss_newton=GaussNewton(300.0, 1)
    )
    picture = HostStep.sign_picture(given)
    assert picture is not None
    assert level.mask is not None
    assert (np.abs(picture) == 2.0 * (level.mask > 0)).all()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_the_weight_of_a_step_multiplies_its_gradients_and_not_its_loss(backend: str) -> None:
    plain, loss = stepped(backend, 1)
    weighted, same_loss = stepped(backend, 1, weight=4.0)
    assert same_loss == loss
    np.testing.assert_allclose(weighted.moment1, 4.0 * plain.moment1, rtol=1e-5)


@pytest.mark.parametrize(("degree", "outside"), [(0, ""), (1, ""), (1, IGNORE), (1, TRANSPARENT)])
def test_one_step_leaves_the_same_moments_counts_and_loss(degree: int, outside: str) -> None:
    kernels, losses = stepped("cpu", 1, degree, outside)
    plain, wanted = stepped("reference", 1, degree, outside)
    assert losses == pytest.approx(wanted, rel=1e-5)
    for name in ("moment1", "moment2", "gradient_sum"):
        found, known = getattr(kernels, name), getattr(plain, name)
        np.testing.assert_allclose(found, known, atol=2e-4 * np.abs(known).max())
    for name in ("gradient_count", "steps"):
        np.testing.assert_array_equal(getattr(kernels, name), getattr(plain, name))


@pytest.mark.parametrize("outside", ["", IGNORE, TRANSPARENT])
def test_light_is_corrected_alike(outside: str) -> None:
    light = (0.7, -0.4, 0.1)
    kernels, losses = stepped("cpu", 1, 1, outside, light)
    plain, wanted = stepped("reference", 1, 1, outside, light)
    assert losses == pytest.approx(wanted, rel=1e-5)
    atol = 2e-4 * np.abs(plain.moment1).max()
    np.testing.assert_allclose(kernels.moment1, plain.moment1, atol=atol)
    assert losses != stepped("reference", 1, 1, outside)[1]


def test_many_steps_end_at_the_same_loss() -> None:
    _, losses = stepped("cpu", 20)
    _, wanted = stepped("reference", 20)
    np.testing.assert_allclose(losses, wanted, rtol=1e-3)
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_coefficients_above_a_splats_own_degree_are_not_trained(backend: str) -> None:
    level, start = level_of(cloud(80, 40, 30, degree=1)), cloud(60, 40, 30, degree=1, seed=4)
    model = new_model(*(array.copy() for array in splat_arrays(start)))
    poor = np.arange(60) % 2 == 0
    model.sh_degrees[poor] = 0
    stepper = step_of(backend)
    stepper.load(model)
    for _ in range(3):
        stepper.step(StepInput(level, RasterSettings(near=0.1, sh_degree=1), RATES))
    after = stepper.model().sh
    assert np.array_equal(after[poor, 1:], start.sh[poor, 1:])
    assert (after[~poor, 1:] != start.sh[~poor, 1:]).any()
    assert (after[poor, 0] != start.sh[poor, 0]).any()
