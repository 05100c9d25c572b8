"""Rows 1-4, 6-8 and 31: footprints of extreme shape, and their gradients."""

from __future__ import annotations

import functools

import numpy as np
import torch

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.raster.reference import parameters_of, project, render_tensors, rotation_matrices
from tests.extremes import gpu, kernels
from tests.extremes.measured import Measured, broken, broken_gradients, difference, worst
from tests.extremes.oracles import finite_differences
from tests.extremes.sixty_digits import exact_gradients
from tests.scenes import PARAMETERS, camera, cloud, gradients, relative, splats, textbook_alpha
from tests.tolerances import (
    CLAMP_GRADIENT,
    COMPENSATION,
    FLOAT32_GRADIENT,
    FLOAT32_IMAGE,
    NEEDLE_1E3,
    NEEDLE_1E4,
    ORACLE,
    SCALED_QUATERNION,
    UNIT_ROTATION,
)

FLAT = np.ones((48, 64, 3), np.float32)


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


def needle_1e3(backend):
    return _needle(backend, 1, needle(1e3, 1e3), NEEDLE_1E3)


def needle_1e4(backend):
    return _needle(backend, 2, needle(1e4, 1e4), NEEDLE_1E4)


def _needle(backend, row, scene, bound):
    view = camera(160, 120)
    wanted = textbook_alpha(scene, view)
    assert (wanted > 0.5).any()
    error = difference(_alpha(backend, scene, view), wanted)
    return [Measured(row, "alpha", error, ORACLE if backend == "reference" else bound)]


def _alpha(backend, scene, view):
    if backend != "reference":
        return render(scene, view, RasterSettings(), backend).alpha
    with torch.no_grad():  # in float64: `render` returns float32
        return render_tensors(parameters_of(scene), view, RasterSettings())[1].numpy()


def far_below_a_pixel(backend):
    scene, view = splats((0, 0, 1), scales=1e-4 / 60, opacities=0.99), camera()
    found = []
    for antialias in (False, True):
        v = gradients(backend, scene, view, FLAT, RasterSettings(antialias=antialias))
        what = f"gradients not finite, antialiasing {'on' if antialias else 'off'}"
        found.append(Measured(3, what, broken_gradients(v), 0))
    error = _compensation_error(backend, scene, view)
    return [*found, Measured(3, "opacity compensation, relative", error, COMPENSATION)]


def _compensation_error(backend, scene, view):
    """det(V V^T) / det(V V^T + e I) = (s^2 / (s^2 + e))^2 for a round footprint of variance s^2.

    The others give only splats that are drawn, so there e is as small as the splat.
    """
    s2 = (np.exp(np.float64(scene.log_scales[0, 0])) * 60) ** 2
    dilation = 0.3 if backend == "cpu" else 1e-9
    settings = RasterSettings(antialias=True, dilation_px2=dilation)
    if backend == "cpu":
        found = kernels.compensation(scene, view, settings)
    elif backend in gpu.COLUMNS:
        found = gpu.opacity(backend, scene, view, settings) / float(scene.opacities[0])
    else:
        opacities = project(parameters_of(scene), view, settings).opacities.detach()
        found = float(opacities[0]) / float(scene.opacities[0])
    return abs(found * (s2 + dilation) / s2 - 1)


def huge(backend):
    view, pictures, gradients_broken = camera(), [], 0
    for log_scale in (10, 20, 30, 40):
        scene = splats((0.1, 0.2, 3), opacities=0.7, rgb=(1, 1, 1))
        scene.log_scales[:] = log_scale
        image = render(scene, view, RasterSettings(), backend).image
        pictures.append(difference(image, 0.7))
        gradients_broken += broken_gradients(gradients(backend, scene, view, FLAT))
    return [
        Measured(4, "image", worst(pictures), FLOAT32_IMAGE),
        Measured(4, "gradients not finite", gradients_broken, 0),
    ]


def far_and_wide(backend):
    """A footprint as wide as its centre is far from the picture."""
    view, found, values_broken = camera(16, 12), [], 0
    v = np.random.default_rng(1).uniform(0.2, 1.0, (12, 16, 3)).astype(np.float32)
    for size_px in (1e3, 1e5, 1e7, 1e9, 1e12, 1e16, 1e19, 2e20):
        scene = _beside(size_px)
        measured, wanted = gradients(backend, scene, view, v), exact_gradients(scene, view, v)
        values_broken += broken_gradients(measured)
        values_broken += broken(render(scene, view, RasterSettings(), backend).image)
        others = worst(relative(measured[n], wanted[n]) for n in wanted if n != "means")
        mean = relative(measured["means"], wanted["means"])
        beyond = backend == "reference" and size_px > 1e12
        found.append(
            Measured(
                31,
                f"gradient by the mean, {size_px:g} px, relative",
                mean,
                FLOAT32_GRADIENT,
                NEARLY_CANCELS if beyond else "",
            )
        )
        found.append(
            Measured(31, f"other gradients, {size_px:g} px, relative", others, FLOAT32_GRADIENT)
        )
    return [*found, Measured(31, "values and gradients not finite", values_broken, 0)]


NEARLY_CANCELS = (
    "moved away, such a splat shrinks and comes nearer to the picture; autograd in float64 has no "
    "digits for the little that is left of the two"
)


def _beside(size_px, z=3.0):
    size = size_px * z / 60.0
    return splats(
        (0.9 * size, -0.6 * size, z),
        scales=size * np.array([1.0, 0.7, 1.2]),
        opacities=0.8,
        rgb=(1, 1, 1),
        quaternions=(0.8, 0.1, -0.3, 0.2),
    )


def quaternions_of_any_norm(backend):
    view, direction = camera(), np.array([0.5, -0.1, 0.7, 0.2])
    miscounted, values_broken, drawn_though_culled, turns = 0, 0, 0, []
    for norm in (0.0, 1e-23, 1e-10, 1.0, 1e20):
        scene = needle(10, 20)
        scene.quaternions[:] = direction / np.linalg.norm(direction) * norm
        drawn = render(scene, view, RasterSettings(), backend)
        values_broken += broken(drawn.image)
        values_broken += broken_gradients(gradients(backend, scene, view, FLAT))
        miscounted += drawn.culled != (norm < 1e-20)
        if norm < 1e-20:
            drawn_though_culled += int(drawn.image.any())
            continue
        if backend in gpu.COLUMNS:
            continue  # its kernels tell no rotation
        if backend == "cpu":
            r = kernels.rotation(scene, view, RasterSettings())
        else:
            r = rotation_matrices(parameters_of(scene).quaternions)[0].detach().numpy()
        turns.append(difference(r.T @ r, np.eye(3)))
    return [
        *(Measured(6, "R^T R - I", worst(turns), UNIT_ROTATION) for _ in turns[:1]),
        Measured(6, "culled but not counted, or the reverse", miscounted, 0),
        Measured(6, "culled but drawn", drawn_though_culled, 0),
        Measured(6, "values and gradients not finite", values_broken, 0),
    ]


def longer_quaternion(backend):
    scene, longer, view = cloud(60), cloud(60), camera()
    v = np.random.default_rng(0).normal(size=(48, 64, 3)).astype(np.float32)
    longer.quaternions[:] *= np.float32(1024)  # a power of two: no rounding of its own
    a, b = (render(s, view, RasterSettings(), backend).image for s in (scene, longer))
    one, other = (gradients(backend, s, view, v)["quaternions"] for s in (scene, longer))
    return [
        Measured(7, "image", difference(b, a), SCALED_QUATERNION),
        Measured(7, "gradient x 1024, relative", relative(other * 1024, one), SCALED_QUATERNION),
    ]


# Faint and broad: no pixel near the cap or the cut-off, so that the picture is smooth.
BEYOND = {
    "x/z": (0.9, 0.03, 3.0),
    "-x/z": (-0.9, -0.05, 3.0),
    "y/z": (0.02, 0.8, 3.0),
    "both": (-0.8, 0.7, 3.0),
}


def beyond_the_clamp(backend):
    found = []
    for side in BEYOND:
        scene, view, v = _beyond(side)
        wanted = _beyond_differences(side)
        measured = gradients(backend, scene, view, v)
        all_of_them = worst(relative(measured[name], wanted[name]) for name in PARAMETERS)
        z, wanted_z = measured["means"][0, 2], wanted["means"][0, 2]
        found.append(Measured(8, f"gradients, {side}, relative", all_of_them, CLAMP_GRADIENT))
        found.append(
            Measured(8, f"gradient by z, {side}, relative", abs(z / wanted_z - 1), CLAMP_GRADIENT)
        )
    return found


def _beyond(side):
    mean = BEYOND[side]
    scene = splats(
        mean, scales=(0.55, 0.4, 0.5), opacities=0.6, quaternions=(0.8, 0.1, -0.3, 0.2)
    ).with_sh_degree(1)
    scene.sh[:, 1:] = np.random.default_rng(2).normal(0, 0.1, (1, 3, 3))
    v = np.random.default_rng(1).uniform(0.2, 1.0, (10, 12, 3)).astype(np.float32)
    return scene, camera(12, 10), v


@functools.cache
def _beyond_differences(side):
    return finite_differences(*_beyond(side))
