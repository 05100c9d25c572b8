"""What each splat is worth to a set of photographs, and which splats are floaters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.measure.judge import Photograph
from stages.raster.backends import rasteriser_of
from stages.raster.definition import splat_arrays
from stages.raster.draw import settings_of
from stages.scene import Camera, Splats

SEEN = 1.0 / 255.0  # a weight below it cannot change an 8-bit picture
NEAR_CAMERA = 0.25  # of the depth at which that camera sees the scene
FEW_PHOTOGRAPHS = 2
RIM = 0.25  # of the longer side: as far as seeds continue a photograph beyond its rim


@dataclass(frozen=True)
class Worth:
    """Per splat [N]. sse_change: of the summed squared error over all photographs if it alone
    were removed (negative: they would be better without it). weight: summed blend weight;
    largest_weight: in any pixel. photographs: in how many it has a weight of 1/255 somewhere.
    sse: summed squared error now. scene_depth [photographs]: median depth of each picture.
    """

    sse_change: NDArray[np.float64]
    weight: NDArray[np.float64]
    largest_weight: NDArray[np.float64]
    photographs: NDArray[np.int32]
    sse: float
    scene_depth: NDArray[np.float64]


def measure_worth(splats: Splats, photographs: Iterable[Photograph], backend: str) -> Worth:
    """What each splat does for the photographs, drawn by its own look."""
    n = len(splats)
    change, weight, largest = np.zeros(n), np.zeros(n), np.zeros(n)
    seen_in, sse, depths = np.zeros(n, np.int32), 0.0, []
    rasteriser, arrays = rasteriser_of(backend), splat_arrays(splats)
    settings = settings_of(splats)
    for photograph in photographs:
        forward = rasteriser.forward(arrays, photograph.camera, settings, depths=True)
        target = photograph.image.transpose(2, 0, 1)
        residual = np.ascontiguousarray(forward.image[:3] - target)
        if photograph.kept is not None:
            residual *= photograph.kept
        sse += float(np.sum(residual.astype(np.float64) ** 2))
        solid = forward.image[4][forward.image[3] > 0.5]
        depths.append(float(np.median(solid)) if solid.size else np.inf)
        found = rasteriser.contributions(forward, residual)
        rows = forward.visible
        change[rows] += found[:, 0]
        weight[rows] += found[:, 1]
        largest[rows] = np.maximum(largest[rows], found[:, 2])
        seen_in[rows] += found[:, 2] >= SEEN
    return Worth(change, weight, largest, seen_in, sse, np.array(depths))


def floaters(splats: Splats, worth: Worth, cameras: list[Camera]) -> NDArray[np.bool_]:
    """[N] splats that hang in empty space: close before a camera, compared with what that camera
    sees behind, and needed by at most two photographs."""
    close = np.zeros(len(splats), bool)
    for camera, depth in zip(cameras, worth.scene_depth, strict=True):
        if np.isfinite(depth):
            distance = np.linalg.norm(splats.means - camera.centre, axis=1)
            close |= distance < NEAR_CAMERA * depth
    return np.asarray(close & (worth.photographs <= FEW_PHOTOGRAPHS))


def beside_pictures(splats: Splats, cameras: list[Camera]) -> NDArray[np.bool_]:
    """[N] splats in a picture or just beyond its rim, where the next view will look."""
    beside = np.zeros(len(splats), bool)
    for camera in cameras:
        pixels, z = camera.project(splats.means)
        size = np.array([camera.width, camera.height])
        margin = RIM * size.max()
        beside |= (z > 0) & ((pixels > -margin) & (pixels < size + margin)).all(1)
    return beside


def unneeded(worth: Worth, beside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[N] splats that no photograph is better for: seen, and the error does not grow without
    them; or never seen, and not beside any picture either (see `beside_pictures`). What continues a
    picture beyond its rim no photograph speaks against, and views in between show it."""
    seen = worth.photographs > 0
    return np.asarray((seen & (worth.sse_change <= 0.0)) | (~seen & ~beside))
