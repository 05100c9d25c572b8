"""The working memory of one tile of 16x16 pixels: planes of 256 floats, 4x4 pixels a vector.

Plane p of a tile's work holds block b (b % 4 across, b // 4 down) at p + 16 b, row by row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.raster.cpu.binning import BLOCK, TILE
from stages.raster.kernels.simd import (
    kernel,
    vload,
    vload4x4,
    vstore,
    vstore4x4,
)

PIXELS = TILE * TILE
BLOCKS = 16
NEVER = np.float32(3e38)  # the last entry drawn in a pixel that was not finished
_F = np.float32


class DrawnTiles(NamedTuple):
    """A picture's tiles as kernels take them: entries starts[t]..starts[t + 1] are the splats of
    tile t, nearest first. Kernels unpack it before they loop: each access to an array of a tuple
    changes a reference count, which threads would contend for.

    members [I]: row of the splat. slots [I]: where the entry's gradient goes; the slots of a splat
    are contiguous. masks [I]: 4x4 blocks of the tile that the splat touches. geometry, paint: of
    all rows, filled for visible ones. transmittance, last: see `blend.blend_tiles`.
    """

    width: int
    height: int
    starts: NDArray[np.int64]
    members: NDArray[np.int32]
    slots: NDArray[np.int32]
    masks: NDArray[np.uint16]
    geometry: NDArray[np.float64]
    paint: NDArray[np.float32]
    background: NDArray[np.float32]
    transmittance: NDArray[np.float32]
    last: NDArray[np.float32]


@kernel
def load_plane(picture, channel, tile_x, tile_y, work, plane):
    """A tile of picture[channel] into a plane of `work`; 0 outside the picture."""
    height, width = picture.shape[1], picture.shape[2]
    left, top = tile_x * TILE, tile_y * TILE
    if left + TILE <= width and top + TILE <= height:
        for block in range(BLOCKS):
            y, x = top + BLOCK * (block // 4), left + BLOCK * (block % 4)
            at = (channel * height + y) * width + x
            vstore(work, plane + 16 * block, vload4x4(picture, at, width))
        return
    for block in range(BLOCKS):
        for k in range(16):
            y, x = top + BLOCK * (block // 4) + k // 4, left + BLOCK * (block % 4) + k % 4
            inside = y < height and x < width
            work[plane + 16 * block + k] = picture[channel, y, x] if inside else _F(0.0)


@kernel
def store_plane(picture, channel, tile_x, tile_y, work, plane):
    """The inverse of `load_plane`."""
    height, width = picture.shape[1], picture.shape[2]
    left, top = tile_x * TILE, tile_y * TILE
    if left + TILE <= width and top + TILE <= height:
        for block in range(BLOCKS):
            y, x = top + BLOCK * (block // 4), left + BLOCK * (block % 4)
            at = (channel * height + y) * width + x
            vstore4x4(picture, at, width, vload(work, plane + 16 * block))
        return
    for block in range(BLOCKS):
        for k in range(16):
            y, x = top + BLOCK * (block // 4) + k // 4, left + BLOCK * (block % 4) + k % 4
            if y < height and x < width:
                picture[channel, y, x] = work[plane + 16 * block + k]


@kernel
def start_transmittance(tile_x, tile_y, width, height, work, transmittance, last):
    """Transmittance 1 and last NEVER in the tile's pixels; 0 and 0 outside the picture.

    transmittance, last: planes of `work`. Returns the mask of blocks in the picture.
    """
    alive = 0
    for block in range(BLOCKS):
        y, x = tile_y * TILE + BLOCK * (block // 4), tile_x * TILE + BLOCK * (block % 4)
        if y < height and x < width:
            alive |= 1 << block
        for k in range(16):
            inside = y + k // 4 < height and x + k % 4 < width
            work[transmittance + 16 * block + k] = _F(1.0) if inside else _F(0.0)
            work[last + 16 * block + k] = NEVER if inside else _F(0.0)
    return alive


@kernel
def last_of_blocks(last, tile, block_last):
    """block_last [16]: the last entry drawn in each block of a tile. Returns the largest."""
    furthest = _F(0.0)
    for block in range(BLOCKS):
        block_last[block] = _F(0.0)
        for k in range(16):
            block_last[block] = max(block_last[block], last[tile, 16 * block + k])
        furthest = max(furthest, block_last[block])
    return furthest
