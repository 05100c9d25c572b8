"""Numbers computed by hand, on both backends."""

import numpy as np
import pytest
import torch

from stages.raster.camera_row import camera_row
from stages.raster.cpu.projection import (
    A,
    B,
    C,
)
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.raster.reference import parameters_of, project, sh_basis
from stages.scene import Camera
from tests.raster.kernel_values import footprint_values
from tests.raster.kernel_values import sh_basis_values as kernel_basis
from tests.scenes import BACKENDS, LIGHT_BACKENDS, camera, splats
from tests.tolerances import WORKED

VIEW = Camera(1600, 1200, 800.0, 800.0, 800.0, 600.0, np.eye(4))
NO_DILATION = RasterSettings(dilation_px2=0.0)
HALF_TURN = np.sqrt(0.5)


def covariance(backend, scene, settings=NO_DILATION):
    """[[a, b], [b, c]] of the only splat."""
    if backend == "reference":
        p = project(parameters_of(scene), VIEW, settings)
        a, b, c = (float(t.detach()[0]) for t in (p.a, p.b, p.c))
    else:
        w = footprint_values(0, camera_row(VIEW, settings), splat_arrays(scene))
        a, b, c = w[A], w[B], w[C]
    return np.array([[a, b], [b, c]])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("quaternion", "depth_scale", "wanted", "sigmas", "angle", "area"),
    [
        ((1, 0, 0, 0), 1, [[6401.56, 0.78], [0.78, 900.39]], (80.01, 30.01), 0.008, 7542),
        (
            (np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0),
            1,
            [[4088.28, 222.27], [222.27, 912.70]],
            (64.06, 29.95),
            3.98,
            6028,
        ),
    ],
)
def test_footprint_worked_by_hand(backend, quaternion, depth_scale, wanted, sigmas, angle, area):
    scene = splats((0.5, 0.25, 4.0), scales=(0.4, 0.15, 0.05), quaternions=quaternion)
    cov = covariance(backend, scene)
    np.testing.assert_allclose(cov, wanted, rtol=WORKED, atol=0.006)
    values, vectors = np.linalg.eigh(cov)
    np.testing.assert_allclose(np.sqrt(values[::-1]), sigmas, atol=0.006)
    along = vectors[:, 1]
    assert np.degrees(np.arctan(along[1] / along[0])) == pytest.approx(angle, abs=0.006)
    assert np.pi * np.sqrt(np.linalg.det(cov)) == pytest.approx(area, abs=0.6)


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_twice_the_depth_halves_the_footprint(backend):
    scene = splats((1.0, 0.5, 8.0), scales=(0.4, 0.15, 0.05))
    assert np.sqrt(covariance(backend, scene)[0, 0]) == pytest.approx(40.0, abs=0.01)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_mass_of_a_drawn_splat_within_one_two_and_three_sigma(backend):
    """39.3, 86.5 and 98.9 % of 2 pi sigma^2 times its opacity."""
    sigma = 30.0
    view = camera(201, 201, 60.0)
    scene = splats((0, 0, 4.0), scales=4.0 * sigma / 60.0, opacities=0.99)
    alpha = render(scene, view, NO_DILATION, backend).alpha
    ys, xs = np.mgrid[:201, :201] - 100.0
    mass = 2 * np.pi * sigma**2 * 0.99
    within = [alpha[np.hypot(xs, ys) <= n * sigma].sum() / mass for n in (1, 2, 3)]
    np.testing.assert_allclose(within, (0.393, 0.865, 0.989), atol=0.003)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("alphas", "weights", "residual"),
    [((0.6, 0.5, 0.2), (0.6, 0.2, 0.04), 0.16), ((0.5, 0.4, 0.25), (0.5, 0.2, 0.075), 0.225)],
)
def test_layers_blend_front_to_back(backend, alphas, weights, residual):
    # wide splats centred on the pixel: their falloff there is 1
    scene = splats([(0, 0, 2), (0, 0, 3), (0, 0, 4)], scales=1.0, opacities=alphas, rgb=np.eye(3))
    view = camera(1, 1)
    drawn = render(scene, view, RasterSettings(), backend)
    np.testing.assert_allclose(drawn.image[0, 0], weights, atol=1e-6)
    assert 1 - drawn.alpha[0, 0] == pytest.approx(residual, abs=1e-6)
    depth = np.dot(weights, (2, 3, 4)) / np.sum(weights)
    assert drawn.depth[0, 0] == pytest.approx(depth, rel=1e-5)


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_three_sigma_is_drawn_and_worth_its_gaussian(backend):
    """exp(-4.5) = 0.0111 at 3 sigma: a cut there would be visible for an opaque splat."""
    view = camera(101, 1, focal=100.0)
    scene = splats((0, 0, 1), scales=0.1, opacities=0.9, rgb=(1, 1, 1))
    settings = RasterSettings(dilation_px2=0.0)
    row = render(scene, view, settings, backend).image[0, :, 0]
    assert row[50 + 30] == pytest.approx(0.9 * 0.0111, abs=2e-5)
    assert row[50 + 32] > 0  # alpha reaches 1/255 at sqrt(2 ln(255 x 0.9)) = 3.297 sigma
    assert row[50 + 33] == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("direction", "wanted"),
    [((0, 0, 1), 0.526396), ((1, 0, 0), 0.159944), ((0, 1, 0), -0.206508)],
)
def test_spherical_harmonics_worked_by_hand(backend, direction, wanted):
    coefficients = np.array([1, 1, 0.5, 0.25])
    if backend == "reference":
        basis = sh_basis(torch.tensor([direction], dtype=torch.float64), 1)[0].numpy()
    else:
        basis = kernel_basis(1, np.array([direction], float))[0]
    assert basis @ coefficients == pytest.approx(wanted, abs=1e-6)


def test_spherical_harmonics_are_orthonormal_and_alike_in_both_backends():
    r = np.random.default_rng(0)
    directions = r.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(torch.tensor(directions), 3).numpy()
    # Monte Carlo: the standard error of a mean of 200,000 is about 0.003 x 4 pi / 4 pi
    np.testing.assert_allclose(4 * np.pi * basis.T @ basis / len(basis), np.eye(16), atol=0.03)
    np.testing.assert_allclose(kernel_basis(3, directions[:20]), basis[:20], atol=1e-14)


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_median_depth_is_where_half_of_the_light_is_gone(backend):
    """Light after each of three splats: 0.7, 0.42, 0.21; and 0.7 after one alone."""
    depths = [1.0, 2.0, 3.0]
    scene = splats([(0, 0, z) for z in depths], scales=9.0, opacities=[0.3, 0.4, 0.5])
    drawn = render(scene, camera(1, 1), RasterSettings(), backend)
    assert drawn.median_depth[0, 0] == 2.0
    assert drawn.depth[0, 0] == pytest.approx((0.3 * 1 + 0.28 * 2 + 0.21 * 3) / 0.79, rel=1e-4)
    alone = render(scene.take(np.array([0])), camera(1, 1), RasterSettings(), backend)
    assert alone.median_depth[0, 0] == 0.0


def test_a_picture_of_1080p_has_8160_tiles_and_an_aligned_box_covers_ten():
    view = Camera(1920, 1080, 1000.0, 1000.0, 0.0, 0.0, np.eye(4))
    rasteriser = CpuRasteriser()
    # reach is sqrt(2 ln(255 o)) sigmas; an 80 x 30 px box around the centre of tiles 0..4 x 0..1
    reach = np.sqrt(2 * np.log(255 * 0.5))
    sigma = np.array([39.0, 14.0]) / reach
    scene = splats(
        (0.040, 0.016, 1.0),
        scales=(np.sqrt(sigma[0] ** 2) / 1000, np.sqrt(sigma[1] ** 2) / 1000, 1e-6),
    )
    forward = rasteriser.forward(splat_arrays(scene), view, RasterSettings(dilation_px2=1e-6))
    assert forward.n_intersections == 10
    assert len(forward.tiles.starts) - 1 == 120 * 68 == 8160
