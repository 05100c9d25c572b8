"""Colours for formats whose colours do not change with the view."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stages.measure.contribution import colours_by_degree
from stages.raster.backends import rasteriser_of
from stages.raster.definition import WEIGHT, splat_arrays
from stages.raster.draw import raster_settings_of
from stages.scene import Camera, Splats, dc_to_rgb, rgb_to_dc


def flat_dc(splats: Splats, cameras: Iterable[Camera], backend: str) -> NDArray[np.float32]:
    """[N, 3] the DC coefficient of each splat's mean colour, over the directions from which the
    cameras see it, by its weight in their pictures; its own DC where none sees it."""
    rasteriser, arrays, settings = (
        rasteriser_of(backend),
        splat_arrays(splats),
        raster_settings_of(splats),
    )
    own = dc_to_rgb(splats.sh[:, 0].astype(np.float64))
    total, weights = np.zeros((len(splats), 3)), np.zeros((len(splats), 1))
    for camera in cameras:
        forward = rasteriser.forward(arrays, camera, settings)
        nothing = np.zeros((3, camera.height, camera.width), np.float32)
        weight = rasteriser.contributions(forward, nothing)[:, WEIGHT, None]
        rows = forward.visible
        colours = colours_by_degree(splats.take(rows), camera.centre)[:, -1]
        total[rows] += weight * colours
        weights[rows] += weight
    seen = weights[:, 0] > 0
    own[seen] = total[seen] / weights[seen]
    return rgb_to_dc(own).astype(np.float32)
