"""Extreme inputs on every backend: the rows of the extremes table hold their bounds, and no value
of any parameter corrupts what it does not belong to."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from stages.raster.definition import LOG_SCALE_MAX, QUATERNION_MIN, RasterSettings
from stages.raster.draw import render
from stages.scene import rgb_to_dc
from tests.extremes.table import ROWS, measured
from tests.scenes import BACKENDS, PARAMETERS, camera, cloud, gradients, join, relative, splats
from tests.tolerances import FLOAT32_IMAGE


def cases():
    for row in ROWS:
        for backend in row.backends:
            if backend in BACKENDS:  # the GPU's are in test_gpu
                name = f"row_{row.number:02d}-{row.name}-{backend}"
                yield pytest.param(row, backend, id=name)


@pytest.mark.parametrize(("row", "backend"), list(cases()))
def test_every_number_of_the_table_is_within_its_bound(row, backend):
    beyond = [m for m in measured(row, backend) if not m.accepted]
    assert not beyond, "\n".join(f"{m.what}: {m.error:.3g} > {m.bound:.3g}" for m in beyond)


# The hostile sweep: one bad value at a time, in a small picture.
VIEW = camera(20, 14, focal=30.0)
V = np.random.default_rng(2).normal(size=(14, 20, 3)).astype(np.float32)
F = np.float32
LARGEST, LEAST_NORMAL, LEAST = F(np.finfo(F).max), F(np.finfo(F).tiny), F(1e-45)
PLANES = ("image", "alpha", "depth", "median_depth")
NOT_NUMBERS = (np.nan, np.inf, -np.inf)
EXTREMES = (LARGEST, -LARGEST, LEAST, -LEAST, LEAST_NORMAL / F(2), -LEAST_NORMAL / F(2))
THRESHOLDS = {
    "means": (F(RasterSettings().near),),
    "quaternions": (F(QUATERNION_MIN), F(-QUATERNION_MIN)),
    "log_scales": (F(LOG_SCALE_MAX),),
    "opacity_logits": (F(np.log(1 / 254)),),
    "sh": (F(rgb_to_dc(np.zeros(1))[0]),),
}


def some():
    """A few splats all over the picture, of degree 1."""
    scene = cloud(12, 20, 14, degree=1, seed=3, size_px=2.0)
    scene.means[:, :2] *= 2.0  # `cloud` is made for a focal length of 60
    return scene


def with_value(slot, component, value):
    """One splat in front of the others, with this value in one component."""
    bad = splats((0.02, -0.03, 1.5), scales=(0.1, 0.05, 0.07), opacities=0.6).with_sh_degree(1)
    bad.sh[:, 1:] = 0.1
    bad.quaternions[:] = (0.8, 0.1, -0.3, 0.2)
    if slot == "quaternions" and abs(value) < 1e-10:
        bad.quaternions[:] = 0  # so that the small value is the largest
    getattr(bad, slot).reshape(-1)[component] = value
    return bad


def components(slot):
    return {"means": 3, "quaternions": 4, "log_scales": 3, "opacity_logits": 1, "sh": 12}[slot]


def near_threshold(slot):
    for value in THRESHOLDS[slot]:
        yield from (np.nextafter(value, F(-np.inf)), value, np.nextafter(value, F(np.inf)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_no_number_is_culled_and_counted_wherever_it_stands(backend):
    """All at once: every component of every parameter x NaN, inf and -inf."""
    bad = [
        with_value(slot, component, value)
        for slot in PARAMETERS
        for component in range(components(slot))
        for value in NOT_NUMBERS
    ]
    both = join(*bad, some())
    drawn = render(both, VIEW, RasterSettings(), backend)
    assert drawn.culled == len(bad) == 69
    alone = render(some(), VIEW, RasterSettings(), backend)
    for part in PLANES:
        np.testing.assert_array_equal(getattr(drawn, part), getattr(alone, part))
    found, wanted = (gradients(backend, scene, VIEW, V) for scene in (both, some()))
    for name in PARAMETERS:
        assert not found[name][: len(bad)].any()
        np.testing.assert_array_equal(found[name][len(bad) :], wanted[name])


@functools.cache
def others(backend):
    return render(some(), VIEW, RasterSettings(), backend)


def check_hostile(backend, slot, component, value):
    """The picture: finite, and where the bad splat does not reach, as without it.

    Its own gradients may pass what float32 holds (colours of 1e38); the optimiser then leaves it
    alone.
    """
    bad = with_value(slot, component, value)
    both = join(bad, some())
    drawn = render(both, VIEW, RasterSettings(), backend)
    alone = render(bad, VIEW, RasterSettings(), backend)
    assert drawn.culled == alone.culled
    untouched = alone.alpha == 0
    for part in PLANES:
        found = getattr(drawn, part)
        assert np.isfinite(found).all(), part
        np.testing.assert_array_equal(found[untouched], getattr(others(backend), part)[untouched])
    found = gradients(backend, both, VIEW, V)
    for name in PARAMETERS:
        assert np.isfinite(found[name][1:]).all(), name
    return drawn


@pytest.mark.parametrize("slot", PARAMETERS)
@pytest.mark.parametrize("kind", ["largest and least", "about the threshold"])
def test_hostile_values_corrupt_nothing_else(slot, kind):
    """The largest, the least and what is at a threshold, in every component of every parameter:
    pictures and the others' gradients are finite, other pixels stand, and backends agree."""
    for component in range(components(slot)):
        for value in EXTREMES if kind == "largest and least" else near_threshold(slot):
            a, b = (check_hostile(backend, slot, component, value) for backend in BACKENDS)
            assert a.culled == b.culled, (component, value)
            assert relative(b.image, a.image) <= FLOAT32_IMAGE, (component, value)


@pytest.mark.parametrize("near", [-0.1, -1e-30, np.nan])
def test_a_near_plane_behind_the_camera_is_refused(near):
    with pytest.raises(ValueError, match="wanted 0 or more"):
        RasterSettings(near=near)


def test_colours_are_never_squashed():
    """Colour is 0.5 + SH, clamped below only: no sigmoid anywhere."""
    scene = splats((0, 0, 2), scales=5.0, opacities=0.5, rgb=(3.0, -1.0, 0.25))
    np.testing.assert_allclose(scene.sh[0, 0], rgb_to_dc(np.array([3.0, -1.0, 0.25])), rtol=1e-6)
    for backend in BACKENDS:
        pixel = render(scene, camera(1, 1), RasterSettings(), backend).image[0, 0]
        np.testing.assert_allclose(pixel, [1.5, 0.0, 0.125], atol=1e-6)
