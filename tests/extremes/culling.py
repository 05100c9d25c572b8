"""Rows 5, 9, 10 and 24: what is not drawn, and what is then left."""

from __future__ import annotations

import numpy as np

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from tests.extremes.measured import Measured, broken, broken_gradients, difference, worst
from tests.scenes import (
    PARAMETERS,
    camera,
    cloud,
    gradients,
    join,
    render_filtered,
    splats,
    textbook_alpha,
)
from tests.tolerances import FLOAT32_IMAGE, FLOAT32_OUTPUT

FLAT = np.ones((48, 64, 3), np.float32)


def scales_out_of_range(backend):
    good, view, settings = cloud(50), camera(), RasterSettings()
    alone = render(good, view, settings, backend).image
    pictures, miscounted, values_broken, left = [], 0, 0, 0
    for bad in (45.0, 89.0, np.inf, -np.inf, np.nan):
        culled = cloud(2, seed=9)
        culled.log_scales[0, 1] = bad
        culled.log_scales[1, 0] = bad
        both = join(culled, good)
        drawn = render(both, view, settings, backend)
        miscounted += abs(drawn.culled - 2)
        pictures.append(difference(drawn.image, alone))
        found = gradients(backend, both, view, FLAT)
        values_broken += broken_gradients(found)
        left += sum(int(np.count_nonzero(found[name][:2])) for name in PARAMETERS)
    return [
        Measured(5, "image of the others", worst(pictures), 0),
        Measured(5, "miscounted", miscounted, 0),
        Measured(5, "gradients not finite", values_broken, 0),
        Measured(5, "gradients of the culled that are not 0", left, 0),
    ]


def widths_out_of_range(backend):
    """Smoothing filters of a width that is none."""
    good, view, settings = cloud(50), camera(), RasterSettings()
    at_ease = np.full(50, 0.01, np.float32)
    alone = render_filtered(good, view, settings, backend, at_ease).image
    bad = np.array([np.nan, np.inf, -np.inf, -0.01, np.exp(45.0)], np.float32)
    both = join(cloud(len(bad), seed=9), good)
    widths = np.concatenate([bad, at_ease])
    drawn = render_filtered(both, view, settings, backend, widths)
    found = gradients(backend, both, view, FLAT, settings, widths)
    left = sum(int(np.count_nonzero(found[name][: len(bad)])) for name in PARAMETERS)
    return [
        Measured(35, "image of the others", difference(drawn.image, alone), 0),
        Measured(35, "miscounted", abs(drawn.culled - len(bad)), 0),
        Measured(35, "gradients not finite", broken_gradients(found), 0),
        Measured(35, "gradients of the culled that are not 0", left, 0),
    ]


def near_plane(backend):
    """Drawn where z > near, z and near compared in float64; see `RasterSettings.near`."""
    wrong, values_broken = 0, 0
    for near in (0.01, 0.5, 1.0):
        at = np.float32(near)
        for z in (np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(9))):
            scene = splats((0, 0, z), scales=0.1 * near, opacities=0.8)
            settings = RasterSettings(near=near)
            drawn = render(scene, camera(), settings, backend)
            found = gradients(backend, scene, camera(), FLAT, settings)
            visible = float(z) > near
            wrong += (bool(drawn.image.any()) != visible) + (drawn.culled != 0)
            wrong += any(found[name].any() for name in PARAMETERS) != visible
            values_broken += broken(
                drawn.image, drawn.depth, drawn.median_depth
            ) + broken_gradients(found)
    return [
        Measured(9, "z > near but not drawn, or the reverse", wrong, 0),
        *_closer_than_three_sigma(backend, values_broken),
    ]


def _closer_than_three_sigma(backend, values_broken):
    pictures, view = [], camera()
    for sigma_over_z in (1 / 3, 1.0, 10.0, 1e4):
        scene = splats(
            (0.03, -0.02, 0.2), scales=(0.2 * sigma_over_z,) * 3, opacities=0.8, rgb=(1, 1, 1)
        )
        drawn = render(scene, view, RasterSettings(), backend)
        pictures.append(difference(drawn.alpha, textbook_alpha(scene, view)))
        found = gradients(backend, scene, view, FLAT)
        values_broken += broken(drawn.image, drawn.depth, drawn.median_depth) + broken_gradients(
            found
        )
    bound = FLOAT32_OUTPUT if backend == "reference" else FLOAT32_IMAGE
    return [
        Measured(9, "alpha where z <= 3 sigma", worst(pictures), bound),
        Measured(9, "values and gradients not finite", values_broken, 0),
    ]


def not_in_front(backend):
    scene, view, settings = cloud(40), camera(), RasterSettings()
    alone = render(scene, view, settings, backend).image
    pictures, counted = [], 0
    for z in (0.0, -1e-7, -1.0, -1e6):
        behind = splats((0, 0, z), scales=10.0, opacities=0.99)
        drawn = render(join(behind, scene), view, settings, backend)
        pictures.append(difference(drawn.image, alone))
        counted += drawn.culled
    return [
        Measured(10, "image of the others", worst(pictures), 0),
        Measured(10, "counted as what cannot be drawn", counted, 0),
    ]


def nothing_to_draw(backend):
    view, settings = camera(20, 10), RasterSettings(background=(0.1, 0.2, 0.3))
    none, culled = cloud(5).take(np.zeros(5, bool)), cloud(5)
    culled.log_scales[:] = np.nan
    pictures, miscounted, left = [], 0, 0
    for scene in (none, culled):
        drawn = render(scene, view, settings, backend)
        pictures.append(difference(drawn.image, np.array([0.1, 0.2, 0.3], np.float32)))
        miscounted += abs(drawn.culled - len(scene))
        found = gradients(backend, scene, view, np.ones((10, 20, 3)), settings)
        left += int(np.count_nonzero(drawn.alpha))
        left += sum(int(np.count_nonzero(g)) for g in found.values())
    return [
        Measured(24, "background", worst(pictures), 0),
        Measured(24, "miscounted", miscounted, 0),
        Measured(24, "alpha and gradients that are not 0", left, 0),
        Measured(24, "gradient of one behind culled rows", _early_rows(backend), 0),
    ]


def _early_rows(backend):
    """Difference to the gradient of the visible splat alone; of the others, to 0."""
    view, v = camera(), np.random.default_rng(0).normal(size=(48, 64, 3)).astype(np.float32)
    alone = splats((0.1, 0.1, 2), scales=(0.2, 0.1, 0.1))
    culled = splats([(0, 0, 1)] * 7, scales=np.nan)
    behind = splats([(0, 0, -1)] * 3)
    found = gradients(backend, join(culled, behind, alone), view, v)
    wanted = gradients(backend, alone, view, v)
    return worst(
        max(difference(found[name][:10], 0), difference(found[name][10:], wanted[name]))
        for name in PARAMETERS
    )
