"""Depth maps -> one signed distance field (Curless & Levoy, SIGGRAPH 1996)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.memory import MIB, available_mib
from stages.raster.kernels.pool import default_pool
from stages.surface.depth_maps import DepthMap
from stages.surface.fuse_kernels import CAMERA_ROW, integrate

VOXELS = 1 << 24  # 256 cubed; 50,000 triangles cannot show more
TRUNCATION = 4.0  # voxels
_BYTES_A_VOXEL = 16  # two float32, masks, and as much again for what marching cubes makes of them
_SHARE_OF_MEMORY = 0.25
_FAR = 3.0  # times the median depth; beyond lie skies and what shows through a window
_CENTRAL_PERCENT = 1.0, 99.0
_MARGIN = 0.05  # of the longest side: the tip of a thing is fewer pixels than a percent
_SAMPLE_STEP = 37  # prime, so that samples do not line up with rows


@dataclass(frozen=True)
class Volume:
    """distance [X, Y, Z] float32: signed, in voxels, positive before a surface, cut at
    +-TRUNCATION. weight [X, Y, Z] float32: 0 where nothing was seen. corner [3]: centre of the
    first voxel. voxel: its edge, world units."""

    distance: NDArray[np.float32]
    weight: NDArray[np.float32]
    corner: NDArray[np.float64]
    voxel: float

    @property
    def far_corner(self) -> NDArray[np.float64]:
        """[3] centre of the last voxel."""
        return self.corner + self.voxel * (np.array(self.distance.shape) - 1)


def voxel_budget() -> int:
    """VOXELS, or what a quarter of free memory holds."""
    free_mib = available_mib()
    if free_mib is None:
        return VOXELS
    return min(VOXELS, max(1000, int(_SHARE_OF_MEMORY * free_mib * MIB / _BYTES_A_VOXEL)))


def observed_box(
    maps: list[DepthMap],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Corners [3], [3] of the box that most of the trusted pixels lie in; None if there are none.

    Robust at both ends: one far splat must not take the voxels away from everything else.
    """
    sampled = [found.depth[found.weight > 0][::_SAMPLE_STEP] for found in maps]
    if not any(map(len, sampled)):
        return None
    depths = np.concatenate(sampled)
    places = np.concatenate([m.points(_SAMPLE_STEP) for m in maps])
    near = places[depths <= _FAR * np.median(depths)]
    low, high = np.percentile(near, _CENTRAL_PERCENT, axis=0)
    margin = _MARGIN * float((high - low).max())
    return (low - margin, high + margin) if margin > 0 else None


def empty_volume(low: NDArray[np.float64], high: NDArray[np.float64], voxels: int) -> Volume:
    """At most about `voxels` cubes that fill the box from `low` to `high`."""
    voxel = float(np.prod(high - low) / voxels) ** (1 / 3)
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel) + 1)
    return Volume(np.zeros(shape, np.float32), np.zeros(shape, np.float32), low, voxel)


def fuse_depth_maps(maps: list[DepthMap], volume: Volume, near: float) -> Volume:
    """The volume with all maps in it. near: depth from which a camera sees, world units.

    In every voxel the maps are added in their order, so the result does not depend on threads.
    """
    rows, start = np.zeros((len(maps), CAMERA_ROW)), 0
    for row, found in zip(rows, maps, strict=True):
        camera = found.camera
        row[:12] = camera.world_to_camera[:3].ravel()
        row[12:18] = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        row[18] = start
        start += found.depth.size
    default_pool().share(
        integrate,
        volume.distance,
        volume.weight,
        volume.corner,
        volume.voxel,
        TRUNCATION * volume.voxel,
        near,
        rows,
        np.concatenate([found.depth.ravel() for found in maps]),
        np.concatenate([found.weight.ravel() for found in maps]),
    )
    np.multiply(volume.distance, np.float32(TRUNCATION), out=volume.distance)
    return volume
