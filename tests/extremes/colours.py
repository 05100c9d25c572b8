"""Row 26: colours out of every range."""

from __future__ import annotations

import numpy as np

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from tests.extremes.measured import Measured, broken, broken_gradients, difference, worst
from tests.extremes.oracles import inside_clamp, textbook_picture
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, join, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

LARGEST = float(np.finfo(np.float32).max)


def bright_and_broken(backend):
    values_broken, pictures = 0, []
    for value in (1e3, -1e3, 1e10, -1e10):
        scene, view = _with_coefficient(value), camera()
        drawn = render(scene, view, RasterSettings(), backend)
        found = gradients(backend, scene, view, _v())
        values_broken += broken(
            drawn.image, drawn.alpha, drawn.depth, drawn.median_depth
        ) + broken_gradients(found)
        values_broken += drawn.culled
        pictures.append(_image_error(backend, value))
    return [
        Measured(26, "1e3, 1e10: values and gradients not finite", values_broken, 0),
        Measured(26, "1e3, 1e10: image, relative", worst(pictures), FLOAT32_IMAGE),
        *_against_reference(backend),
        *_not_numbers(backend),
    ]


def brightest(backend):
    """Coefficients at float32's end, in a colour that is cut off and in one that just is not."""
    beyond, values_broken, slopes = 0, 0, []
    for value in (LARGEST, -LARGEST, 1e19):
        for degree in (0, 2):
            scene = cloud(100, degree=degree)
            rows = np.arange(0, 100, 10)
            scene.sh[rows, rows // 10 % scene.sh.shape[1], rows % 3] = value
            drawn = render(scene, camera(), RasterSettings(), backend)
            values_broken += broken(drawn.image, drawn.depth, drawn.median_depth) + drawn.culled
            found, wanted = (gradients(b, scene, camera(), _v()) for b in (backend, "reference"))
            beyond += sum(int((~(abs(found[n]) < LARGEST)).sum()) for n in PARAMETERS)
            slopes += [relative(found[name], wanted[name]) for name in PARAMETERS]
    return [
        Measured(32, "values not finite, or culled", values_broken, 0),
        Measured(32, "gradients beyond float32", beyond, 0),
        *(
            [Measured(32, "gradients to the reference, relative", worst(slopes), FLOAT32_GRADIENT)]
            if backend != "reference"
            else []
        ),
    ]


def _image_error(backend, value):
    """Of one with a constant colour, to extended precision."""
    scene, view = cloud(60, degree=0), camera()
    scene = scene.take(inside_clamp(scene, view))
    scene.sh[::7, 0, 1] = value
    image = render(scene, view, RasterSettings(), backend).image
    return relative(image, textbook_picture(scene, view))


def _against_reference(backend):
    if backend == "reference":
        return []
    slopes, view = [], camera()
    for value in (1e3, -1e3, 1e10, -1e10):
        scene = _with_coefficient(value)
        found, wanted = gradients(backend, scene, view, _v()), exact_gradients(scene, view, _v())
        slopes += [relative(found[name], wanted[name]) for name in PARAMETERS]
    what = "1e3, 1e10: gradients to the reference, relative"
    return [Measured(26, what, worst(slopes), FLOAT32_GRADIENT)]


def _v():
    return np.random.default_rng(1).normal(size=(48, 64, 3)).astype(np.float32)


def _with_coefficient(value):
    """One splat in ten has a coefficient of `value`, in each coefficient and channel in turn."""
    scene = cloud(100, degree=2)
    rows = np.arange(0, 100, 10)
    scene.sh[rows, rows // 10 % 9, rows % 3] = value
    return scene


def _not_numbers(backend):
    good, view = cloud(60, degree=2), camera()
    bad = cloud(27, degree=2, seed=8)
    for i in range(27):  # every coefficient of every channel
        bad.sh[i, i // 3, i % 3] = np.nan
    both = join(bad, good)
    drawn = render(both, view, RasterSettings(), backend)
    alone = render(good, view, RasterSettings(), backend).image
    found = gradients(backend, both, view, _v())
    return [
        Measured(26, "NaN: image of the others", difference(drawn.image, alone), 0),
        Measured(26, "NaN: miscounted", abs(drawn.culled - 27), 0),
        Measured(26, "NaN: gradients not finite", broken_gradients(found), 0),
    ]
