"""Answers from elsewhere: extended precision, finite differences, and the picture itself."""

from __future__ import annotations

import numpy as np
import torch

from stages.raster.definition import TRANSMITTANCE_MIN, RasterSettings
from stages.raster.reference import Parameters, parameters_of, render_tensors
from stages.scene import dc_to_rgb
from tests.scenes import PARAMETERS, textbook_alpha

L = np.longdouble


def textbook_picture(scene, view, background=(0.0, 0.0, 0.0)):
    """[H, W, 3] of splats of degree 0 inside the clamp, blended near to far by the definition,
    pixel by pixel of the whole picture: no tiles, no extents."""
    z = depths(scene, view).astype(np.float32)
    image = np.zeros((view.height, view.width, 3), L)
    light = np.ones((view.height, view.width), L)
    rgb = dc_to_rgb(scene.sh[:, 0].astype(L))
    for row in np.argsort(z, kind="stable"):
        alpha = np.where(light >= TRANSMITTANCE_MIN, textbook_alpha(scene, view, row), 0)
        image += (alpha * light)[..., None] * rgb[row]
        light = light * (1 - alpha)
    return (image + light[..., None] * np.array(background, L)).astype(np.float64)


def depths(scene, view):
    """[N] z in the camera."""
    return in_camera(scene, view)[:, 2]


def in_camera(scene, view):
    """[N, 3] positions in the camera, in extended precision."""
    rotation, translation = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    return scene.means.astype(L) @ rotation.T.astype(L) + translation.astype(L)


def means2d(scene, view):
    """[N, 2] px, in extended precision."""
    at = in_camera(scene, view)
    focal, centre = np.array([view.fx, view.fy], L), np.array([view.cx, view.cy], L)
    return (at[:, :2] / at[:, 2:] * focal + centre).astype(np.float64)


def inside_clamp(scene, view):
    """[N] whether a splat is in front and where the affine approximation is not frozen."""
    at = in_camera(scene, view)
    x, y = view.fx * at[:, 0] / at[:, 2], view.fy * at[:, 1] / at[:, 2]
    margin_x, margin_y = 0.15 * view.width, 0.15 * view.height
    good = (x > -view.cx - margin_x) & (x < view.width - view.cx + margin_x)
    good &= (y > -view.cy - margin_y) & (y < view.height - view.cy + margin_y)
    return good & (at[:, 2] > RasterSettings().near)


def centre_in_picture(alpha):
    """(x, y) px of the one splat in a picture.

    The logarithm of its alpha is a paraboloid; its top is found by least squares, each pixel
    weighted by its alpha, which is what float32 keeps of it.
    """
    ys, xs = np.nonzero((alpha > 0.02) & (alpha < 0.985))
    values = alpha[ys, xs].astype(np.float64)
    if len(values) < 6:
        return np.full(2, np.nan)
    origin = np.array([xs[values.argmax()], ys[values.argmax()]])
    x, y = xs - origin[0], ys - origin[1]
    columns = np.stack([x * x, x * y, y * y, x, y, np.ones(len(x))], 1) * values[:, None]
    (a, b, c, d, e, _), _, rank, _ = np.linalg.lstsq(columns, np.log(values) * values)
    if rank < 6:
        return np.full(2, np.nan)
    top = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    return top + origin + 0.5


def finite_differences(scene, view, v_image, names=PARAMETERS, step=1e-6, settings=None):
    """{parameter: gradient of sum(image x v_image)} by central differences of the float64
    reference."""
    settings = settings or RasterSettings()
    v = torch.tensor(np.asarray(v_image, np.float64))
    start = dict(zip(PARAMETERS, (t.detach() for t in parameters_of(scene).tensors()), strict=True))
    found = {}
    for name in names:
        gradient = np.zeros(start[name].numel())
        for i in range(len(gradient)):
            sums = []
            for sign in (1, -1):
                moved = start[name].clone()
                moved.view(-1)[i] += sign * step
                image = render_tensors(Parameters(**start | {name: moved}), view, settings)[0]
                sums.append(float((image * v).sum()))
            gradient[i] = (sums[0] - sums[1]) / (2 * step)
        found[name] = gradient.reshape(start[name].shape)
    return found


def opacity_gradient_of_layers(scene, view, v, background):
    """[N] gradient by opacity logits of a picture of one pixel, whose splats come near to far:
    what lies behind is summed from the back, in extended precision."""
    alpha = np.array([textbook_alpha(scene, view, i)[0, 0] for i in range(len(scene))], L)
    before = np.concatenate([[L(1)], np.cumprod(1 - alpha)[:-1]])
    alpha[before < TRANSMITTANCE_MIN] = 0
    light = np.cumprod(1 - alpha)
    shade = dc_to_rgb(scene.sh[:, 0].astype(L)) @ np.asarray(v, L)
    parts = alpha * before * shade
    behind = np.cumsum(parts[::-1])[::-1] - parts + light[-1] * (np.array(background, L) @ v)
    opacity = 1 / (1 + np.exp(-scene.opacity_logits.astype(L)))
    by_alpha = before * shade - behind / (1 - alpha)
    return (by_alpha * alpha * (1 - opacity)).astype(np.float64)
