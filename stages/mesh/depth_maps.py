"""Depth, confidence and colour of the splats from the training cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.raster.draw import renderer
from stages.scene import Camera, Splats, evenly_spaced

SIDE_PX = 480
MAX_CAMERAS = 200  # more do not improve the proxy; each takes 1.4 MB
_MIN_ALPHA = 0.5  # below it a pixel shows mostly the background
_MIN_COSINE = 0.1  # a surface at more than 84 degrees to the ray, or a depth discontinuity


@dataclass(frozen=True)
class DepthMap:
    """What one camera sees.

    Attributes:
        camera: the camera.
        depth: [H, W] float32 z in the camera, world units.
        weight: [H, W] float32 in 0..1: cosine between the ray and the surface normal, the weight of
            range images in Curless & Levoy 1996; 0 where the depth is unreliable.
        colour: [H, W, 3] uint8.
    """

    camera: Camera
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]
    colour: NDArray[np.uint8]

    def points(self, step: int = 1) -> NDArray[np.float64]:
        """[M, 3] positions in the world of every `step`-th pixel with a weight."""
        trusted = np.flatnonzero(self.weight > 0)[::step]
        places = unproject(self.camera, self.depth).reshape(-1, 3)[trusted]
        pose = self.camera.world_to_camera
        return np.asarray((places - pose[:3, 3]) @ pose[:3, :3])


def unproject(camera: Camera, depth: NDArray[np.floating]) -> NDArray[np.float64]:
    """[H, W, 3] positions of all pixel centres in the axes of the camera."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None])


def select_cameras(cameras: list[Camera]) -> list[Camera]:
    """At most MAX_CAMERAS, evenly spaced, at the size at which depth is drawn."""
    return [camera.fitted(SIDE_PX) for camera in evenly_spaced(cameras, MAX_CAMERAS)]


def draw_depth_maps(
    splats: Splats,
    cameras: list[Camera],
    backend: str,
    tick: Callable[[int], None],
) -> list[DepthMap]:
    """Draw the median depth from each camera: where the transmittance falls to one half.

    Expected depth lies between two surfaces wherever a ray meets both; fused, it is 20 to 50 %
    farther from the sparse points than median depth.

    tick: called with the number of each camera before it is drawn.
    """
    draw, maps = renderer(splats, backend=backend), []
    for number, camera in enumerate(cameras):
        tick(number)
        drawn = draw(camera)
        depth = drawn.median_depth
        solid = (drawn.alpha >= _MIN_ALPHA) & (depth > 0) & np.isfinite(depth)
        depth = np.where(solid, depth, 0).astype(np.float32)
        cosine = surface_cosine(camera, depth)
        weight = np.where(solid & (cosine >= _MIN_COSINE), cosine, 0).astype(np.float32)
        colour = np.rint(255 * np.clip(np.nan_to_num(drawn.image), 0, 1)).astype(np.uint8)
        maps.append(DepthMap(camera, depth, weight, colour))
    return maps


def surface_cosine(camera: Camera, depth: NDArray[np.floating]) -> NDArray[np.float64]:
    """[H, W] cosine between the ray of each pixel and the surface normal, which comes from the
    depths of its neighbours; 1 for a surface that faces the camera."""
    places = unproject(camera, depth)
    if min(depth.shape) < 2:
        return np.ones(depth.shape)
    normal = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    along = np.abs((normal * places).sum(axis=-1))
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(places, axis=-1)
    return np.asarray(along / np.where(length > 0, length, 1))
