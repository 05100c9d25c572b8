"""Splats that are drawn plainly, as near as possible to splats that are drawn with opacity
compensation, and the reverse.

With opacity compensation a footprint of covariance C in a view is drawn with its opacity times
sqrt(det C / det (C + e I)), e the dilation (Mip-Splatting, Yu et al. 2024, section 4.2). Drawn
plainly, the opacity is the same in all views: the mean of these factors over the training views is
the start from which fine-tuning goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.camera_row import clamp_limits
from stages.raster.definition import ALPHA_MIN
from stages.raster.draw import raster_settings_of
from stages.scene import Camera, Splats, evenly_spaced, logit
from stages.scene.rotations import matrices_of

CAMERAS = 50  # at most, evenly spaced: more change the mean little
_OUTSIDE = 1e-3  # weight of a camera whose picture does not hold the mean of a splat


def without_compensation(splats: Splats, cameras: Sequence[Camera]) -> Splats:
    """Splats for plain drawing, made of `splats` that are trained for drawing with compensation.

    cameras: in the world of the splats, at the size of training.
    """
    factors = mean_compensation(splats, cameras)
    smallest = np.finfo(np.float32).tiny
    opacities = np.clip(splats.opacities * factors, smallest, 1 - 1e-7)
    return replace(
        splats,
        opacity_logits=logit(opacities).astype(np.float32),
        draw_settings=replace(splats.draw_settings, antialias=False),
    )


def mean_compensation(splats: Splats, cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[N] factor of each splat's opacity, averaged over the cameras whose picture holds its mean;
    if there is no such camera, over those that the splat is in front of; 1 if no camera is left."""
    settings = raster_settings_of(splats)
    total, weights = np.zeros(len(splats)), np.zeros(len(splats))
    for camera in map(splats.local, evenly_spaced(cameras, CAMERAS)):
        pixels, z = camera.project(splats.means)
        size = camera.width, camera.height
        inside: NDArray[np.bool_] = np.all((pixels >= 0) & (pixels <= size), axis=1)
        seen = np.flatnonzero(z > settings.near)
        weight = np.where(inside[seen], 1.0, _OUTSIDE)
        total[seen] += weight * compensation(splats.take(seen), camera, settings.dilation_px2)
        weights[seen] += weight
    return np.where(weights > 0, total / np.maximum(weights, _OUTSIDE), 1.0)


def compensation(splats: Splats, camera: Camera, dilation_px2: float) -> NDArray[np.float64]:
    """[N] factor of the opacity of splats before the camera; 0 below 1/255, which is not drawn."""
    pixels, z = camera.project(splats.means)
    low_x, high_x, low_y, high_y = clamp_limits(camera)
    rays = np.zeros((len(splats), 2, 3))  # the derivatives of the pixel by the mean, times z
    rays[:, 0, 0], rays[:, 1, 1] = camera.fx, camera.fy
    rays[:, 0, 2] = -camera.fx * np.clip((pixels[:, 0] - camera.cx) / camera.fx, low_x, high_x)
    rays[:, 1, 2] = -camera.fy * np.clip((pixels[:, 1] - camera.cy) / camera.fy, low_y, high_y)
    axes = camera.world_to_camera[:3, :3] @ matrices_of(splats.quaternions)
    scales = np.exp(splats.log_scales.astype(np.float64))[:, None]
    v = rays / z[:, None, None] @ axes * scales
    minors = (np.cross(v[:, 0], v[:, 1]) ** 2).sum(axis=1)  # det C, by Cauchy-Binet
    dilated = minors + dilation_px2 * (v**2).sum(axis=(1, 2)) + dilation_px2**2
    factors = np.sqrt(minors / dilated)
    return np.where(factors >= ALPHA_MIN, factors, 0.0)
