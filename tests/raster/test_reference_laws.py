"""What must hold for any rendering, whatever the numbers; and gradients by finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.raster.reference import Parameters, parameters_of, render_tensors
from stages.scene import Camera, Splats
from tests.scenes import BACKENDS, LIGHT_BACKENDS, PARAMETERS, camera, cloud, join, splats
from tests.tolerances import FINITE_DIFFERENCE, FLOAT32_SHIFT

SETTINGS = RasterSettings(background=(0.2, 0.4, 0.6))


def image(backend, scene, view, settings=SETTINGS):
    return render(scene, view, settings, backend).image


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_hidden_splats_do_not_change_the_picture(backend):
    wall = splats([(0, 0, 1)] * 4 + [(0, 0, 1.1)], scales=5.0, opacities=0.9999)
    places = np.random.default_rng(0).uniform((-1, -1, 4), (1, 1, 6), (20, 3))
    hidden = splats(places, rgb=(0, 1, 0))
    view = camera()
    alone = image(backend, wall, view)
    np.testing.assert_array_equal(image(backend, join(wall, hidden), view), alone)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_order_of_rows_does_not_show_even_at_equal_depths(backend):
    scene = cloud(200)
    scene.means[:100, 2] = 3.0
    scene.means[100:110] = scene.means[0]
    order = np.random.default_rng(1).permutation(len(scene))
    view = camera()
    np.testing.assert_array_equal(
        image(backend, scene.take(order), view), image(backend, scene, view)
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_scaling_world_and_camera_together_changes_nothing(backend):
    scene, factor = cloud(100, degree=1), 8.0
    matrix = np.eye(4)
    matrix[:3, 3] = (0.1, -0.2, 0.3)
    scaled = Splats(
        scene.means * np.float32(factor),
        scene.quaternions,
        scene.log_scales + np.float32(np.log(factor)),
        scene.opacity_logits,
        scene.sh,
        scene.sh_degrees,
    )
    far = matrix.copy()
    far[:3, 3] *= factor
    np.testing.assert_allclose(
        image(backend, scaled, camera(matrix=far), SETTINGS),
        image(backend, scene, camera(matrix=matrix), SETTINGS),
        atol=2e-5,  # log(8) rounded to float32 shifts every log-scale by up to 2e-7 x 3
    )


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_two_halves_of_a_picture_are_the_picture(backend):
    scene, view = cloud(150), camera(64, 48)
    whole = image(backend, scene, view)
    left = Camera(32, 48, 60, 60, 32, 24, np.eye(4))
    right = Camera(32, 48, 60, 60, 0, 24, np.eye(4))
    # a half has other clamp limits; keep to splats whose slope is inside both
    slope = np.abs(scene.means[:, 0] / scene.means[:, 2])
    scene = scene.take(slope < 0.15 * 32 / 60)
    whole = image(backend, scene, view)
    halves = np.hstack([image(backend, scene, left), image(backend, scene, right)])
    np.testing.assert_allclose(halves, whole, atol=FLOAT32_SHIFT)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_picture_is_linear_in_colours(backend):
    scene, view = cloud(80, degree=0), camera()
    black = RasterSettings()
    scene.sh[:] = np.abs(scene.sh)  # all colours positive, so that no clamp interferes
    other = scene.sh * 0.5
    total, half, grey = (replace(scene, sh=sh) for sh in (scene.sh + other, other, other * 0))
    both = image(backend, scene, view, black) + image(backend, half, view, black)
    np.testing.assert_allclose(
        image(backend, total, view, black) + image(backend, grey, view, black), both, atol=3e-6
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_opacity_zero_is_absence(backend):
    scene, view = cloud(60), camera()
    ghost = cloud(30, seed=5)
    ghost.opacity_logits[:] = -50.0
    np.testing.assert_array_equal(
        image(backend, join(scene, ghost), view), image(backend, scene, view)
    )


@pytest.mark.parametrize("antialias", [False, True])
def test_reference_gradients_are_finite_differences(antialias):
    """Few, broad, faint splats: no pixel near the alpha cut-off of a bright one, the cap, the stop
    or the clamp, so that the picture is smooth in every parameter."""
    r = np.random.default_rng(3)
    scene = cloud(6, 24, 20, degree=3, seed=3, size_px=14.0, spread=0.2)
    scene.opacity_logits[:] = r.uniform(-1.5, 0.5, 6)
    view = camera(12, 10, focal=60.0)
    scene.means[:, :2] *= 0.2
    settings = RasterSettings(background=(0.3, 0.2, 0.1), antialias=antialias)
    v = torch.tensor(r.normal(size=(10, 12, 3)))
    p = parameters_of(scene)
    out, _, _, _ = render_tensors(p, view, settings)
    (out * v).sum().backward()
    step = 1e-6
    for name, tensor in zip(PARAMETERS, p.tensors(), strict=True):
        flat = tensor.detach().flatten()
        numeric = torch.zeros_like(flat)
        for i in range(len(flat)):
            values = []
            for sign in (1, -1):
                moved = flat.clone()
                moved[i] += sign * step
                others = {n: t.detach() for n, t in zip(PARAMETERS, p.tensors(), strict=True)}
                others[name] = moved.reshape(tensor.shape)
                shifted, _, _, _ = render_tensors(Parameters(**others), view, settings)
                values.append(float((shifted * v).sum()))
            numeric[i] = (values[0] - values[1]) / (2 * step)
        assert tensor.grad is not None
        top = tensor.grad.abs().max()
        assert top > 0, name
        error = (numeric - tensor.grad.flatten()).abs().max() / top
        assert error < FINITE_DIFFERENCE, name
