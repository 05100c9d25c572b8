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
from stages.scene import Camera, Splats, logit

CAMERAS = 50  # at most, evenly spaced: more change the mean little


def without_compensation(splats: Splats, cameras: Sequence[Camera]) -> Splats:
    """`splats`, which are trained to be drawn with compensation, for plain drawing.

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
    """[N] factor of each splat's opacity, averaged over the cameras that show it; 1 for none."""
    from stages.raster.reference import parameters_of, project
    from stages.scene import evenly_spaced

    settings = replace(raster_settings_of(splats), antialias=True)
    parameters = parameters_of(splats)
    total, views = np.zeros(len(splats)), np.zeros(len(splats))
    for camera in evenly_spaced(cameras, CAMERAS):
        found = project(parameters, splats.local(camera), settings)
        at, rows = found.means2d.detach().numpy(), found.index.numpy()
        inside = ((at > 0) & (at < (camera.width, camera.height))).all(1)
        rows = rows[inside]
        total[rows] += found.opacities.detach().numpy()[inside] / splats.opacities[rows]
        views[rows] += 1
    return np.where(views > 0, total / np.maximum(views, 1), 1.0)
