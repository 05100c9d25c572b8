"""The kernels against the definition: pictures and every gradient."""

import numpy as np
import pytest

from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.raster.kernels.pool import Pool
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

SIZES = [(1, 1), (17, 1), (47, 33), (64, 48), (83, 61)]


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_pictures_agree(size, antialias):
    scene, view = cloud(300, size[0], size[1], degree=3), camera(*size)
    settings = RasterSettings(background=(0.2, 0.5, 0.9), antialias=antialias)
    a, b = (render(scene, view, settings, backend) for backend in ("cpu", "reference"))
    assert a.image.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(a.image, b.image, atol=FLOAT32_IMAGE)
    np.testing.assert_allclose(a.alpha, b.alpha, atol=FLOAT32_IMAGE)
    np.testing.assert_allclose(a.depth, b.depth, atol=10 * FLOAT32_IMAGE)  # depths are up to 6
    # where half of the light is left to a rounding, the median is one splat or the next
    same = np.isclose(a.median_depth, b.median_depth, atol=10 * FLOAT32_IMAGE)
    assert same.mean() > 0.999


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(1, 1), (47, 33), (83, 61)])
def test_every_gradient_agrees(size, degree, antialias):
    scene, view = cloud(250, size[0], size[1], degree, seed=degree), camera(*size)
    settings = RasterSettings(background=(0.2, 0.5, 0.9), antialias=antialias)
    v = np.random.default_rng(1).normal(size=(size[1], size[0], 3)).astype(np.float32)
    found = gradients("cpu", scene, view, v, settings)
    wanted = exact_gradients(scene, view, v, settings)
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) < FLOAT32_GRADIENT, name


def test_a_turned_off_centre_camera_agrees():
    angle = 0.4
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    matrix[:3, 3] = (0.5, -0.3, 1.0)
    view = camera(70, 50, cx=-20.0, cy=-12.0, matrix=matrix)
    scene = cloud(400, degree=2)
    v = np.random.default_rng(1).normal(size=(50, 70, 3)).astype(np.float32)
    a, b = (render(scene, view, RasterSettings(), backend) for backend in ("cpu", "reference"))
    assert a.alpha.max() > 0.5
    np.testing.assert_allclose(a.image, b.image, atol=FLOAT32_IMAGE)
    found, wanted = gradients("cpu", scene, view, v), exact_gradients(scene, view, v)
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) < FLOAT32_GRADIENT, name


def test_gradients_of_an_active_degree_below_the_stored_one_leave_higher_bands_alone():
    scene, view = cloud(100, degree=3), camera()
    v = np.ones((48, 64, 3), np.float32)
    settings = RasterSettings(sh_degree=1)
    found = gradients("cpu", scene, view, v, settings)
    wanted = exact_gradients(scene, view, v, settings)
    assert not found["sh"][:, 4:].any()
    assert relative(found["sh"], wanted["sh"]) < FLOAT32_GRADIENT


def test_results_do_not_depend_on_the_number_of_threads_or_on_earlier_pictures():
    scene, view = cloud(500, degree=1), camera(90, 70)
    v = np.random.default_rng(1).normal(size=(3, 70, 90)).astype(np.float32)
    arrays = splat_arrays(scene)
    results = []
    for threads in (1, 2, 3):
        rasteriser = CpuRasteriser(Pool(threads))
        rasteriser.forward(arrays, camera(33, 17), RasterSettings())
        forward = rasteriser.forward(arrays, view, RasterSettings())
        picture = forward.image.copy()
        results.append((picture, rasteriser.backward(forward, v).parameters.copy()))
    for picture, gradient in results[1:]:
        np.testing.assert_array_equal(picture, results[0][0])
        np.testing.assert_array_equal(gradient, results[0][1])
