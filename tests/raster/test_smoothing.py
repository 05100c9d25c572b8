"""The 3D smoothing filter: what it does to splats, to gradients, and how wide it is."""

import numpy as np
import pytest

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.raster.smoothing import VARIANCE, smoothed, smoothing_widths
from stages.scene import Camera, look_at
from tests.scenes import (
    BACKENDS,
    LIGHT_BACKENDS,
    PARAMETERS,
    camera,
    cloud,
    exact_gradients,
    gradients,
    join,
    relative,
    render_filtered,
    splats,
)
from tests.tolerances import FINITE_DIFFERENCE, FLOAT32_GRADIENT, FLOAT32_IMAGE

WIDE = RasterSettings(background=(0.2, 0.5, 0.9))


def widths_for(scene, seed=3):
    """From far below a splat's size to far above it."""
    r = np.random.default_rng(seed)
    return np.exp(scene.log_scales.mean(1) + r.uniform(-3, 2, len(scene))).astype(np.float32)


def test_a_filter_as_wide_as_the_splat_worked_by_hand():
    """Scales grow by sqrt(2), and the opacity falls by sqrt(2) for each axis."""
    scene = splats((0, 0, 2), scales=0.25, opacities=0.8)
    soft = smoothed(scene, np.array([0.25], np.float32))
    np.testing.assert_allclose(np.exp(soft.log_scales), 0.25 * np.sqrt(2), rtol=1e-6)
    assert soft.opacities[0] == pytest.approx(0.8 / 2**1.5, rel=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_filter_built_in_draws_the_same_picture(backend):
    scene, view = cloud(300), camera()
    widths = widths_for(scene)
    filtered = render_filtered(scene, view, WIDE, backend, widths).image
    np.testing.assert_allclose(
        filtered, render(smoothed(scene, widths), view, WIDE, backend).image, atol=FLOAT32_IMAGE
    )
    assert np.abs(filtered - render(scene, view, WIDE, backend).image).max() > 0.05


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_filter_of_width_0_is_none(backend):
    scene, view = cloud(100), camera()
    none = render_filtered(scene, view, WIDE, backend, np.zeros(100, np.float32))
    np.testing.assert_array_equal(none.image, render(scene, view, WIDE, backend).image)


@pytest.mark.parametrize("antialias", [False, True])
def test_every_gradient_through_the_filter_agrees(antialias):
    scene, view = cloud(250, degree=1), camera()
    settings = RasterSettings(antialias=antialias)
    v = np.random.default_rng(1).normal(size=(48, 64, 3)).astype(np.float32)
    widths = widths_for(scene)
    found = gradients("cpu", scene, view, v, settings, widths)
    wanted = exact_gradients(scene, view, v, settings, widths)
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) < FLOAT32_GRADIENT, name


def test_the_definition_of_the_filter_has_the_gradient_of_its_finite_differences():
    import torch

    from stages.raster.reference import Parameters, apply_smoothing, parameters_of

    p = parameters_of(cloud(20))
    widths = torch.tensor(widths_for(cloud(20)), dtype=torch.float64)

    def total(log_scales):
        moved = Parameters(p.means, p.quaternions, log_scales, p.opacity_logits, p.sh)
        scales, kept = apply_smoothing(moved, widths)
        return (scales.log().sum(1) * torch.arange(1, 21) + 7 * kept).sum()

    total(p.log_scales).backward()
    step = 1e-6
    for row, axis in ((0, 0), (7, 1), (19, 2)):
        shift = torch.zeros_like(p.log_scales)
        shift[row, axis] = step
        with torch.no_grad():
            wanted = (total(p.log_scales + shift) - total(p.log_scales - shift)) / (2 * step)
        assert p.log_scales.grad is not None
        assert float(p.log_scales.grad[row, axis]) == pytest.approx(
            float(wanted), abs=FINITE_DIFFERENCE
        )


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_splats_of_no_size_under_the_filter_leave_all_finite(backend):
    """A ratio of volumes would be 0 / 0 here; a product of ratios per axis is 0."""
    dust = splats([(0, 0, 2)] * 3, scales=0.1)
    dust.log_scales[:] = [[-80, -80, -80], [-300, 0, 0], [40, -300, -300]]
    scene, view = join(dust, cloud(30)), camera()
    widths = np.full(len(scene), 0.01, np.float32)
    drawn = render_filtered(scene, view, WIDE, backend, widths)
    assert np.isfinite(drawn.image).all()
    assert drawn.culled == 0
    found = gradients(backend, scene, view, np.ones((48, 64, 3)), WIDE, widths)
    assert all(np.isfinite(found[name]).all() for name in PARAMETERS)


def test_the_width_is_set_by_the_photograph_that_samples_most_finely():
    means = np.array([(0, 0, 0), (50, 0, 0)], np.float32)
    near, far = (
        Camera(640, 480, 800.0, 800.0, 320.0, 240.0, look_at(np.array([0, 0, -z]), np.zeros(3)))
        for z in (4.0, 8.0)
    )
    both = smoothing_widths(means, [far, near], near=0.1)
    np.testing.assert_allclose(both[0], np.sqrt(VARIANCE) * 4 / 800, rtol=1e-5)
    assert both[1] == both.max()  # seen by none
    assert not smoothing_widths(means, [], near=0.1).any()
