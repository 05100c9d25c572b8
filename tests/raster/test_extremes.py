"""Extreme inputs, row by row (numbers as in the extremes table), on every backend.

float64 torch is the reference; the reference itself is held against the textbook formula in
extended precision where that can be evaluated.
"""

import numpy as np
import pytest

from stages.raster import RasterSettings, render
from stages.raster.projection import AXES, COMPENSATION, WORK_ROW, camera_row, footprint
from stages.raster.reference import parameters_of, project, rotation_matrices
from stages.scene import rgb_to_dc
from tests.scenes import (
    BACKENDS,
    PARAMETERS,
    camera,
    cloud,
    gradients,
    join,
    relative,
    splats,
    textbook_alpha,
)
from tests.tolerances import (
    BLEED,
    FLOAT32_IMAGE,
    FLOAT32_SHIFT,
    MANY_LAYERS,
    NEEDLE_1E3,
    NEEDLE_1E4,
    ORACLE,
    SCALED_QUATERNION,
)
from tests.tolerances import (
    COMPENSATION as COMPENSATION_TOLERANCE,
)


def finite(found):
    return all(np.isfinite(found[name]).all() for name in PARAMETERS)


def needle(aspect, sigma_px, angle=0.6):
    """A splat `sigma_px` long and 1/aspect as thick, across the picture at an odd angle."""
    half = angle / 2
    long = sigma_px / 60.0
    return splats(
        (0.003, 0.002, 1.0),
        scales=(long, long / aspect, long / aspect),
        opacities=0.9,
        rgb=(1, 1, 1),
        quaternions=(np.cos(half), 0, 0, np.sin(half)),
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("aspect", "sigma", "bound"), [(1e3, 1e3, NEEDLE_1E3), (1e4, 1e4, NEEDLE_1E4)]
)
def test_rows_1_and_2_needles_are_drawn(backend, aspect, sigma, bound):
    scene, view = needle(aspect, sigma), camera(160, 120)
    wanted = textbook_alpha(scene, view)
    found = render(scene, view, RasterSettings(), backend).alpha
    assert (wanted > 0.5).any()
    if backend == "reference":
        # float64, but the picture is handed out in float32
        bound = max(ORACLE, 1e-6)
    assert np.abs(found - wanted).max() <= bound


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("antialias", [False, True])
def test_row_3_splats_far_below_a_pixel(backend, antialias):
    scene, view = splats((0, 0, 1), scales=1e-4 / 60, opacities=0.99), camera()
    settings = RasterSettings(antialias=antialias)
    v = np.ones((48, 64, 3), np.float32)
    assert finite(gradients(backend, scene, view, v, settings))
    if not antialias:
        return
    # det(V V^T) / det(V V^T + e I) = (s^2 / (s^2 + e))^2 for a round footprint of variance s^2
    sigma2 = (np.exp(np.float64(scene.log_scales[0, 0])) * 60) ** 2
    wanted = sigma2 / (sigma2 + 0.3)
    if backend == "cpu":
        w = np.empty(WORK_ROW)
        footprint(
            0,
            camera_row(view, settings),
            scene.means,
            scene.quaternions,
            scene.log_scales,
            scene.opacity_logits,
            w,
        )
        found = w[COMPENSATION]
    else:
        bright = RasterSettings(antialias=True, dilation_px2=1e-9)
        sigma2_wanted = sigma2 / (sigma2 + 1e-9)
        projected = project(parameters_of(scene), view, bright)
        found = float(projected.opacities[0]) / float(scene.opacities[0])
        wanted = sigma2_wanted
    assert found == pytest.approx(wanted, rel=COMPENSATION_TOLERANCE)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("log_scale", [10, 20, 30, 40])
def test_row_4_huge_splats_stay_visible(backend, log_scale):
    scene, view = splats((0.1, 0.2, 3), opacities=0.7, rgb=(1, 1, 1)), camera()
    scene.log_scales[:] = log_scale
    found = render(scene, view, RasterSettings(), backend).image
    assert np.abs(found - 0.7).max() <= FLOAT32_IMAGE
    assert finite(gradients(backend, scene, view, np.ones((48, 64, 3)), RasterSettings()))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bad", [45.0, 89.0, np.inf, -np.inf, np.nan])
def test_row_5_scales_out_of_range_are_culled_and_counted(backend, bad):
    good, view = cloud(50), camera()
    broken = cloud(2, seed=9)
    broken.log_scales[0, 1] = bad
    broken.log_scales[1, 0] = bad
    both = join(broken, good)
    drawn = render(both, view, RasterSettings(), backend)
    assert drawn.culled == 2
    np.testing.assert_array_equal(drawn.image, render(good, view, RasterSettings(), backend).image)
    found = gradients(backend, both, view, np.ones((48, 64, 3)))
    assert finite(found)
    assert not any(found[name][:2].any() for name in PARAMETERS)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("norm", [0.0, 1e-23, 1e-10, 1.0, 1e20])
def test_row_6_quaternions_of_any_norm_turn_or_are_culled(backend, norm):
    scene, view = needle(10, 20), camera()
    direction = np.array([0.5, -0.1, 0.7, 0.2])
    scene.quaternions[:] = direction / np.linalg.norm(direction) * norm
    drawn = render(scene, view, RasterSettings(), backend)
    assert np.isfinite(drawn.image).all()
    if norm < 1e-20:
        assert drawn.culled == 1
        assert not drawn.image.any()
        return
    assert drawn.culled == 0
    if backend == "reference":
        r = rotation_matrices(parameters_of(scene).quaternions)[0].detach().numpy()
    else:
        w = np.empty(WORK_ROW)
        cam = camera_row(view, RasterSettings())
        footprint(0, cam, scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits, w)
        r = w[AXES : AXES + 9].reshape(3, 3)
    np.testing.assert_allclose(r.T @ r, np.eye(3), atol=1e-6)
    assert finite(gradients(backend, scene, view, np.ones((48, 64, 3))))


@pytest.mark.parametrize("backend", BACKENDS)
def test_row_7_a_longer_quaternion_is_the_same_turn_with_a_smaller_gradient(backend):
    scene, view = cloud(60), camera()
    v = np.random.default_rng(0).normal(size=(48, 64, 3)).astype(np.float32)
    longer = cloud(60)
    longer.quaternions[:] *= np.float32(1024)  # a power of two: no rounding of its own
    a, b = (render(s, view, RasterSettings(), backend).image for s in (scene, longer))
    np.testing.assert_allclose(a, b, atol=SCALED_QUATERNION)
    one, other = (gradients(backend, s, view, v)["quaternions"] for s in (scene, longer))
    assert relative(other * 1024, one) <= SCALED_QUATERNION


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("z", [0.0, -1e-7, -1.0, -1e6])
def test_row_10_what_is_not_in_front_is_not_drawn(backend, z):
    behind, view = splats((0, 0, z), scales=10.0, opacities=0.99), camera()
    scene = cloud(40)
    drawn = render(join(behind, scene), view, RasterSettings(), backend)
    np.testing.assert_array_equal(drawn.image, render(scene, view, RasterSettings(), backend).image)
    assert drawn.culled == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_row_11_opaque_black_does_not_let_white_bleed(backend):
    scene = splats([(0, 0, 1), (0, 0, 2), (0, 0, 3)], scales=50, opacities=0.99999, rgb=(0, 0, 0))
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    drawn = render(scene, camera(), white, backend)
    # black as stored in float32 DC is 2e-8
    assert drawn.image.max() <= BLEED + FLOAT32_SHIFT


@pytest.mark.parametrize("backend", BACKENDS)
def test_row_12_four_thousand_layers(backend):
    r = np.random.default_rng(0)
    n = 4000
    z = np.sort(r.uniform(2, 6, n)).astype(np.float32)
    # the falloff at the pixel is 1, so opacity is alpha
    scene = splats(
        np.stack([np.zeros(n), np.zeros(n), z], 1),
        scales=1.0,
        opacities=r.uniform(0.0043, 0.02, n),
        rgb=r.uniform(0, 1, (n, 3)),
    )
    scene.means[:, 0] = r.normal(0, 0.05, n)
    view = camera(1, 1)
    settings = RasterSettings(background=(1.0, 0.5, 0.0))
    v = np.array([[[1.0, -0.7, 0.4]]], np.float32)
    found = gradients(backend, scene, view, v, settings)
    wanted = gradients("reference", scene, view, v, settings)
    deep = slice(n // 2, None)
    for name in PARAMETERS:
        if name == "quaternions":
            continue  # round splats: their turn changes nothing, and rounding is all there is
        assert relative(found[name], wanted[name]) <= MANY_LAYERS, name
        if np.abs(wanted[name][deep]).max() > 1e-12:
            assert relative(found[name][deep], wanted[name][deep]) <= 10 * MANY_LAYERS, name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("offset", [-1e-4, 1e-4])
def test_row_13_at_the_cap_gradients_are_finite_differences(backend, offset):
    view, v = camera(1, 1), np.ones((1, 1, 3), np.float32)
    scene = splats((0, 0, 2), scales=1.0, opacities=0.99 + offset, rgb=(0.8, 0.8, 0.8))
    found = gradients(backend, scene, view, v)["opacity_logits"][0]
    step = 1e-3  # alpha moves by 1e-5, which does not cross the cap
    values = []
    for sign in (1, -1):
        moved = splats((0, 0, 2), scales=1.0, opacities=0.99 + offset, rgb=(0.8, 0.8, 0.8))
        moved.opacity_logits[:] += np.float32(sign * step)
        values.append(float(render(moved, view, RasterSettings(), "reference").image.sum()))
    if offset > 0:
        assert values[0] == values[1]
        assert found == 0.0
    else:
        opacity = scene.opacities[0]
        assert found == pytest.approx(2.4 * opacity * (1 - opacity), rel=1e-4)
        # the picture is float32: its difference over 2e-3 is good to about 1e-4
        assert found == pytest.approx((values[0] - values[1]) / (2 * step), abs=2e-4)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("ulps", [-1, 0, 1])
def test_row_14_opacity_at_one_part_in_255(backend, ulps):
    scene, view = splats((0, 0, 2), scales=0.5), camera()
    logit = np.float32(np.log(1 / 254))
    towards = np.float32(np.inf if ulps > 0 else -np.inf)
    scene.opacity_logits[:] = logit if ulps == 0 else np.nextafter(logit, towards)
    drawn = render(scene, view, RasterSettings(), backend)
    assert np.isfinite(drawn.image).all()
    assert np.isfinite(drawn.depth).all()
    assert finite(gradients(backend, scene, view, np.ones((48, 64, 3))))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("logit", [-100.0, -20.0, 20.0, 100.0])
def test_row_15_opacity_logits_far_out(backend, logit):
    scene, view = splats((0, 0, 2), scales=0.5), camera()
    scene.opacity_logits[:] = logit
    drawn = render(scene, view, RasterSettings(), backend)
    assert np.isfinite(drawn.image).all()
    assert drawn.alpha.max() == (pytest.approx(0.99, abs=1e-3) if logit > 0 else 0.0)
    assert finite(gradients(backend, scene, view, np.ones((48, 64, 3))))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("at", [(16.0, 16.0), (32.0, 8.0), (0.0, 0.0), (64.0, 48.0), (15.5, 15.5)])
def test_row_22_a_mean_on_a_tile_edge(backend, at):
    view = camera(64, 48)
    x, y = (at[0] - 32) / 60 * 2, (at[1] - 24) / 60 * 2
    scene = splats((x, y, 2), scales=(0.2, 0.05, 0.1), opacities=0.8, rgb=(1, 1, 1))
    found = render(scene, view, RasterSettings(), backend).alpha
    assert np.abs(found - textbook_alpha(scene, view)).max() <= FLOAT32_SHIFT
    assert found.any()


@pytest.mark.parametrize("size", [(1, 1), (17, 1), (47, 33)])
def test_row_23_odd_sizes_are_as_the_reference(size):
    scene, view = cloud(120, *size), camera(*size)
    a, b = (render(scene, view, RasterSettings(), backend) for backend in BACKENDS)
    np.testing.assert_allclose(a.image, b.image, atol=FLOAT32_IMAGE)


@pytest.mark.parametrize("backend", BACKENDS)
def test_row_24_nothing_to_draw_is_the_background(backend):
    view, settings = camera(20, 10), RasterSettings(background=(0.1, 0.2, 0.3))
    wanted = np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (10, 20, 3))
    none = cloud(5).take(np.zeros(5, bool))
    culled = cloud(5)
    culled.log_scales[:] = np.nan
    for scene in (none, culled):
        drawn = render(scene, view, settings, backend)
        np.testing.assert_array_equal(drawn.image, wanted)
        assert not drawn.alpha.any()
        assert drawn.culled == len(scene)
        found = gradients(backend, scene, view, np.ones((10, 20, 3)), settings)
        assert not any(g.any() for g in found.values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_row_24_one_visible_splat_behind_culled_rows_gets_its_own_gradient(backend):
    view = camera()
    v = np.random.default_rng(0).normal(size=(48, 64, 3)).astype(np.float32)
    alone = splats((0.1, 0.1, 2), scales=(0.2, 0.1, 0.1))
    culled = splats([(0, 0, 1)] * 7, scales=np.nan)
    behind = splats([(0, 0, -1)] * 3)
    found = gradients(backend, join(culled, behind, alone), view, v)
    wanted = gradients(backend, alone, view, v)
    for name in PARAMETERS:
        assert not found[name][:10].any()
        np.testing.assert_array_equal(found[name][10:], wanted[name])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45])
@pytest.mark.parametrize("slot", PARAMETERS)
def test_hostile_values_corrupt_nothing_else(backend, slot, value):
    """Finite pictures and gradients; where the bad splat is culled, the others' pixels stand."""
    good, bad, view = cloud(40, degree=1), cloud(1, degree=1, seed=4), camera()
    getattr(bad, slot).reshape(1, -1)[0, 0] = value
    both = join(bad, good)
    drawn = render(both, view, RasterSettings(), backend)
    if not np.isfinite(value):
        assert drawn.culled == 1
        np.testing.assert_array_equal(
            drawn.image, render(good, view, RasterSettings(), backend).image
        )
        found = gradients(backend, both, view, np.ones((48, 64, 3)))
        assert finite(found)
    assert not np.isnan(drawn.image).any()
    assert not np.isnan(drawn.alpha).any()


def test_colours_are_never_squashed():
    """Colour is 0.5 + SH, clamped below only: no sigmoid anywhere."""
    scene = splats((0, 0, 2), scales=5.0, opacities=0.5, rgb=(3.0, -1.0, 0.25))
    np.testing.assert_allclose(scene.sh[0, 0], rgb_to_dc(np.array([3.0, -1.0, 0.25])), rtol=1e-6)
    for backend in BACKENDS:
        pixel = render(scene, camera(1, 1), RasterSettings(), backend).image[0, 0]
        np.testing.assert_allclose(pixel, [1.5, 0.0, 0.125], atol=1e-6)
