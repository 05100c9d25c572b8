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

from stages.raster.draw import raster_settings_of
from stages.scene import Camera, Splats, evenly_spaced, logit

CAMERAS = 50  # at most, evenly spaced: more change the mean little
_OPAQUE = 40.0  # a logit
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
    from stages.raster.reference import footprints, parameters_of  # it loads torch

    opaque = replace(splats, opacity_logits=np.full(len(splats), _OPAQUE, np.float32))
    settings, parameters = raster_settings_of(splats.with_antialias(True)), parameters_of(opaque)
    total, weights = np.zeros(len(splats)), np.zeros(len(splats))
    for camera in map(splats.local, evenly_spaced(cameras, CAMERAS)):
        pixels, z = camera.project(splats.means)
        inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        weight = np.where(z > settings.near, np.where(inside, 1.0, _OUTSIDE), 0.0)
        found = footprints(parameters, camera, settings)  # without factors below 1/255
        factors = np.zeros(len(splats))
        factors[found.index.numpy()] = found.opacities.detach().numpy()
        total += weight * factors
        weights += weight
    return np.where(weights > 0, total / np.maximum(weights, _OUTSIDE), 1.0)
