"""The kernel of the fusion: each voxel reads its distance to the surface in each depth map."""

from __future__ import annotations

import numpy as np

from stages.raster.kernels.simd import kernel, take_ticket

# Columns of a camera's row: world_to_camera (3 x 4, row by row), fx, fy, cx, cy, width, height,
# where its pixels start.
CAMERA_ROW = 19
_FX, _FY, _CX, _CY, _WIDTH, _HEIGHT, _START = 12, 13, 14, 15, 16, 17, 18


@kernel
def _clip(low, high, start, slope):
    """The part of [low, high] where start + slope k >= 0."""
    if slope == 0.0:
        return (low, high) if start >= 0.0 else (low, low - 1.0)
    at = -start / slope
    return (max(low, at), high) if slope > 0.0 else (low, min(high, at))


@kernel
def _row_in_view(camera, x, y, z, dx, dy, dz, count, near):
    """First and last k in 0..count - 1 for which (x, y, z) + k (dx, dy, dz) is in the picture."""
    fx, fy, cx, cy = camera[_FX], camera[_FY], camera[_CX], camera[_CY]
    right, below = camera[_WIDTH] - cx, camera[_HEIGHT] - cy
    low, high = _clip(0.0, count - 1.0, z - near, dz)
    low, high = _clip(low, high, fx * x + cx * z, fx * dx + cx * dz)
    low, high = _clip(low, high, right * z - fx * x, right * dz - fx * dx)
    low, high = _clip(low, high, fy * y + cy * z, fy * dy + cy * dz)
    low, high = _clip(low, high, below * z - fy * y, below * dz - fy * dy)
    return int(np.ceil(low)), int(np.floor(high))


@kernel
def integrate(ticket, distance, weight, corner, voxel, truncation, near, cameras, depths, weights):
    """Add the depth maps to the running means, slab by slab, in their order in each voxel.

    distance [X, Y, Z]: mean signed distance as a share of the truncation, -1..1, positive before
    the surface. weight [X, Y, Z]: sum of the weights. corner [3]: of the first voxel's centre.
    cameras [V, CAMERA_ROW]. depths, weights: pixels of all pictures, one after the other.
    """
    nx, ny, nz = distance.shape
    while True:
        i = take_ticket(ticket)
        if i >= nx:
            break
        for view in range(len(cameras)):
            m = cameras[view]
            dx, dy, dz = voxel * m[2], voxel * m[6], voxel * m[10]
            width, height, start = int(m[_WIDTH]), int(m[_HEIGHT]), int(m[_START])
            fx, fy, cx, cy = m[_FX], m[_FY], m[_CX], m[_CY]
            px = corner[0] + voxel * i
            for j in range(ny):
                py = corner[1] + voxel * j
                x = m[0] * px + m[1] * py + m[2] * corner[2] + m[3]
                y = m[4] * px + m[5] * py + m[6] * corner[2] + m[7]
                z = m[8] * px + m[9] * py + m[10] * corner[2] + m[11]
                first, last = _row_in_view(m, x, y, z, dx, dy, dz, nz, near)
                for k in range(first, last + 1):
                    depth_here = z + k * dz
                    inverse = 1.0 / depth_here
                    column = min(max(int(fx * (x + k * dx) * inverse + cx), 0), width - 1)
                    row = min(max(int(fy * (y + k * dy) * inverse + cy), 0), height - 1)
                    pixel = start + row * width + column
                    pixel_weight = weights[pixel]
                    ahead = depths[pixel] - depth_here
                    if pixel_weight > 0.0 and ahead > -truncation:
                        share = min(1.0, ahead / truncation)
                        total = weight[i, j, k] + pixel_weight
                        distance[i, j, k] += (share - distance[i, j, k]) * pixel_weight / total
                        weight[i, j, k] = total
