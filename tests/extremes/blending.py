"""Rows 11-16: opaque, faint and many layers."""

from __future__ import annotations

import functools

import numpy as np

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import SH_C0
from tests.extremes.measured import Measured, broken, broken_gradients, difference, worst
from tests.extremes.oracles import finite_differences, opacity_gradient_of_layers
from tests.scenes import PARAMETERS, camera, cloud, gradients, relative, splats
from tests.tolerances import BLEED, CAP_GRADIENT, FLOAT32_IMAGE, FLOAT32_SHIFT, MANY_LAYERS

FLAT = np.ones((48, 64, 3), np.float32)


def opaque_black(backend):
    scene = splats([(0, 0, 1), (0, 0, 2), (0, 0, 3)], scales=50, opacities=0.99999, rgb=(0, 0, 0))
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    image = render(scene, camera(), white, backend).image
    # black as stored in float32 DC is 2e-8
    return [Measured(11, "white that shows", difference(image, 0), BLEED + FLOAT32_SHIFT)]


def saturated(backend):
    """Splats at the cap, one behind the other: two leave exactly 1e-4 of the light."""
    n, view = 10_000, camera(1, 1)
    z = np.linspace(1, 2, n)
    scene = splats(
        np.stack([0 * z, 0 * z, z], 1), scales=50, opacities=0.99999, rgb=np.full((n, 3), 2.0)
    )
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    found = gradients(backend, scene, view, np.ones((1, 1, 3), np.float32), white)["sh"][:, 0, 0]
    light = np.array([1.0, 0.01, 1e-4])
    passed = 0.01 ** len(light)  # three are drawn
    image = render(scene, view, white, backend).image
    return [
        Measured(30, "image", difference(image, 2 - passed), FLOAT32_IMAGE),
        Measured(
            30,
            "gradients by colour of the first three, each relative",
            worst(relative(found[i : i + 1], 0.99 * light[i : i + 1] * SH_C0) for i in range(3)),
            MANY_LAYERS,
        ),
        Measured(30, "gradients behind them that are not 0", int(np.count_nonzero(found[3:])), 0),
    ]


BACKGROUND = (1.0, 0.5, 0.0)
V_PIXEL = np.array([1.0, -0.7, 0.4], np.float32)


@functools.cache
def _layers(n=4000):
    r = np.random.default_rng(0)
    z = np.sort(r.uniform(2, 6, n)).astype(np.float32)
    # the falloff at the pixel is 1, so opacity is alpha
    scene = splats(
        np.stack([np.zeros(n), np.zeros(n), z], 1),
        scales=1.0,
        opacities=r.uniform(0.0043, 0.02, n),
        rgb=r.uniform(0, 1, (n, 3)),
    )
    # inside the clamp, of which extended precision knows nothing
    scene.means[:, 0] = np.clip(r.normal(0, 0.05, n), -0.01 * z, 0.01 * z)
    return scene


@functools.cache
def _gradients_of_layers(backend):
    v = V_PIXEL[None, None]
    return gradients(backend, _layers(), camera(1, 1), v, RasterSettings(background=BACKGROUND))


def many_layers(backend):
    """Light runs out after some 770 of the 4000: the deepest are the last tenth of those."""
    found = _gradients_of_layers(backend)
    wanted = opacity_gradient_of_layers(_layers(), camera(1, 1), V_PIXEL, BACKGROUND)
    deep = _deepest(wanted)
    everywhere = relative(found["opacity_logits"], wanted)
    deepest = relative(found["opacity_logits"][deep], wanted[deep])
    return [
        Measured(12, "gradients by opacity, relative", everywhere, MANY_LAYERS),
        Measured(12, "the deepest, to their own largest", deepest, 10 * MANY_LAYERS),
        *_layers_against_reference(backend, deep),
    ]


def _deepest(gradient):
    seen = np.flatnonzero(gradient)
    return seen[-(len(seen) // 10) :]


def _layers_against_reference(backend, deep):
    if backend == "reference":
        return []
    found, wanted = _gradients_of_layers(backend), _gradients_of_layers("reference")
    # round splats: their turn changes nothing, and rounding is all there is
    names = [name for name in PARAMETERS if name != "quaternions"]
    everywhere = worst(relative(found[n], wanted[n]) for n in names)
    deepest = worst(relative(found[n][deep], wanted[n][deep]) for n in names)
    return [
        Measured(12, "all gradients to the reference, relative", everywhere, MANY_LAYERS),
        Measured(12, "all of the deepest, to their own largest", deepest, 10 * MANY_LAYERS),
    ]


def at_the_cap(backend):
    view, v, errors = camera(1, 1), np.ones((1, 1, 3), np.float32), {}
    for offset in (-1e-4, 1e-4):
        scene = splats((0, 0, 2), scales=1.0, opacities=0.99 + offset, rgb=(0.8, 0.8, 0.8))
        found = float(gradients(backend, scene, view, v)["opacity_logits"][0])
        # a step of 1e-6 moves alpha by 1e-8, which does not cross the cap
        numeric = float(
            finite_differences(scene, view, v, ("opacity_logits",))["opacity_logits"][0]
        )
        opacity = float(scene.opacities[0])
        exact = 2.4 * opacity * (1 - opacity) if offset < 0 else 0.0
        errors[offset] = [abs(found - wanted) / (exact or 1) for wanted in (numeric, exact)]
    below, above = errors[-1e-4], errors[1e-4]
    return [
        Measured(13, "below the cap, to finite differences", below[0], CAP_GRADIENT),
        Measured(13, "below the cap, to the formula", below[1], CAP_GRADIENT),
        Measured(13, "above the cap: gradient and difference are 0", worst(above), 0),
    ]


def at_one_part_in_255(backend):
    logit = np.float32(np.log(1 / 254))
    down, up = (np.nextafter(logit, np.float32(to)) for to in (-np.inf, np.inf))
    found = sum(_broken_at(backend, value)[0] for value in (down, logit, up))
    return [Measured(14, "values and gradients not finite", found, 0)]


def logits_far_out(backend):
    values_broken, alphas = 0, []
    for logit in (-100.0, -20.0, 20.0, 100.0):
        count, alpha = _broken_at(backend, np.float32(logit))
        values_broken += count
        alphas.append(abs(alpha - (0.99 if logit > 0 else 0.0)))
    return [
        Measured(15, "values and gradients not finite", values_broken, 0),
        Measured(15, "largest alpha: 0 or 0.99", worst(alphas), FLOAT32_SHIFT),
    ]


def _broken_at(backend, logit):
    """(values that are not finite, largest alpha) of one splat of this opacity."""
    scene, view = splats((0, 0, 2), scales=0.5), camera()
    scene.opacity_logits[:] = logit
    drawn = render(scene, view, RasterSettings(), backend)
    found = gradients(backend, scene, view, FLAT)
    count = broken(drawn.image, drawn.alpha, drawn.depth, drawn.median_depth) + broken_gradients(
        found
    )
    return count, float(drawn.alpha.max())


def faint_everywhere(backend):
    """As after an opacity reset: who still has a gradient by its position?"""
    found = []
    for size_px, antialias in ((3.0, False), (0.3, False), (3.0, True), (0.3, True)):
        scene = cloud(400, degree=0, size_px=size_px, spread=0.0)
        u, v = (60 * scene.means[:, :2] / scene.means[:, 2:] + (32, 24)).T
        scene = scene.take((u > 0) & (u < 64) & (v > 0) & (v < 48))
        scene.opacity_logits[:] = np.log(0.01 / 0.99)
        weights = np.random.default_rng(0).normal(size=(48, 64, 3)).astype(np.float32)
        settings = RasterSettings(antialias=antialias)
        means = gradients(backend, scene, camera(), weights, settings)["means"]
        what = f"share with a gradient, sigma {size_px:g} px{', antialiased' * antialias}"
        found.append(Measured(16, what, float((means != 0).any(1).mean()), None))
    return found
