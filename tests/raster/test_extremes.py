"""Extreme inputs on every backend: the rows of the extremes table hold their bounds, and no value
of any parameter corrupts what it does not belong to."""

from __future__ import annotations

import numpy as np
import pytest

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import rgb_to_dc
from tests.extremes.table import ROWS, measured
from tests.raster.hostile_values import (
    EXTREMES,
    NOT_NUMBERS,
    PLANES,
    VIEW,
    V,
    check_hostile,
    components,
    near_threshold,
    some,
    with_value,
)
from tests.scenes import BACKENDS, PARAMETERS, camera, gradients, join, relative, splats
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
