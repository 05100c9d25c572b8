"""One bad value at a time, in every component of every parameter, in a small picture."""

from __future__ import annotations

import functools

import numpy as np

from stages.raster.definition import LOG_SCALE_MAX, QUATERNION_MIN, RasterSettings
from stages.raster.draw import render
from stages.scene import rgb_to_dc
from tests.scenes import PARAMETERS, camera, cloud, gradients, join, splats

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
