"""Depth maps -> truncated signed distance field (Curless & Levoy, SIGGRAPH 1996)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.memory import MIB, available_mib
from stages.mesh.depth_maps import DepthMap
from stages.mesh.fuse_kernels import CAMERA_ROW, integrate
from stages.raster.kernels.pool import default_pool

VOXELS = 1 << 24  # 256 cubed; 50,000 triangles cannot represent more
TRUNCATION = 4.0  # voxels
_BYTES_A_VOXEL = 16  # two float32, masks, and as much again for marching cubes
_SHARE_OF_MEMORY = 0.25
_MAX_DEPTH = 3.0  # times the median depth; beyond it lie skies and views through windows
_CENTRAL_PERCENT = 1.0, 99.0
_MARGIN = 0.05  # of the longest side: tips of objects cover less than a percent of the pixels
_SAMPLE_STEP = 37  # prime, so that samples do not line up with rows


@dataclass(frozen=True)
class Volume:
    """A truncated signed distance field.

    Attributes:
        distance: [X, Y, Z] float32 signed distance in voxels, positive in front of a surface,
            truncated at +-TRUNCATION.
        weight: [X, Y, Z] float32; 0 where nothing was observed.
        corner: [3] centre of the first voxel.
        voxel: edge of a voxel, world units.
    """

    distance: NDArray[np.float32]
    weight: NDArray[np.float32]
    corner: NDArray[np.float64]
    voxel: float


def voxel_budget() -> int:
    """The number of voxels: VOXELS, or as many as a quarter of the free memory holds."""
    return min(VOXELS, max(1000, int(_SHARE_OF_MEMORY * available_mib() * MIB / _BYTES_A_VOXEL)))


def observed_box(
    maps: list[DepthMap],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Corners (low [3], high [3]) of the box that holds most pixels with a weight; None if there
    are none. Percentiles keep a single far splat from enlarging the voxels."""
    sampled = [depth_map.depth[depth_map.weight > 0][::_SAMPLE_STEP] for depth_map in maps]
    if not any(map(len, sampled)):
        return None
    depths = np.concatenate(sampled)
    places = np.concatenate([m.points(_SAMPLE_STEP) for m in maps])
    near = places[depths <= _MAX_DEPTH * np.median(depths)]
    low, high = np.percentile(near, _CENTRAL_PERCENT, axis=0)
    margin = _MARGIN * float((high - low).max())
    return (low - margin, high + margin) if margin > 0 else None


def empty_volume(low: NDArray[np.float64], high: NDArray[np.float64], voxels: int) -> Volume:
    """An empty volume of at most about `voxels` voxels that fills the box from `low` to `high`."""
    voxel = float(np.prod(high - low) / voxels) ** (1 / 3)
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel) + 1)
    return Volume(np.zeros(shape, np.float32), np.zeros(shape, np.float32), low, voxel)


def fuse_depth_maps(maps: list[DepthMap], volume: Volume, near: float) -> Volume:
    """Add all maps to the volume, in place. near: the near plane, world units.

    Every voxel adds the maps in their order, so the result does not depend on threads.
    """
    rows, start = np.zeros((len(maps), CAMERA_ROW)), 0
    for row, depth_map in zip(rows, maps, strict=True):
        camera = depth_map.camera
        row[:12] = camera.world_to_camera[:3].ravel()
        row[12:18] = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        row[18] = start
        start += depth_map.depth.size
    default_pool().share(
        integrate,
        volume.distance,
        volume.weight,
        volume.corner,
        volume.voxel,
        TRUNCATION * volume.voxel,
        near,
        rows,
        np.concatenate([depth_map.depth.ravel() for depth_map in maps]),
        np.concatenate([depth_map.weight.ravel() for depth_map in maps]),
    )
    np.multiply(volume.distance, np.float32(TRUNCATION), out=volume.distance)
    return volume
