"""Contributions of each splat to a picture: its blend weights, the exact change of the squared
error if it is removed, and the terms of that change for any other colour.

Colour is affine in each alpha, so removing one splat changes a pixel by
    dI = -w c + behind alpha / (1 - alpha),
with w its blend weight, c its colour and "behind" what is composited behind it, background and
transmittance included. The squared error against a photograph changes by 2 r dI + dI^2, with r the
residual. A colour change d changes a pixel by w d, and so the error by 2 d sum(w r) + d^2 sum(w^2)
in each channel. This is exact except in pixels where the stopping rule or the alpha cut-off would
then act differently.
"""

from __future__ import annotations

import numpy as np

from stages.raster.cpu.binning import COUNT, SLOT, TILE
from stages.raster.cpu.blend import alpha_of, tile_frame
from stages.raster.cpu.tile import (
    BLOCKS,
    PIXELS,
    last_of_blocks,
    load_plane,
)
from stages.raster.definition import (
    ALPHA_MAX,
    ALPHA_MIN,
    CONTRIBUTIONS,
    ERROR_CHANGE,
    LARGEST_WEIGHT,
    PICTURE_CHANGE,
    SQUARED_WEIGHT,
    WEIGHT,
    WEIGHTED_RESIDUAL,
)
from stages.raster.kernels.simd import (
    bits16,
    kernel,
    lowest_bit,
    splat16,
    take_ticket,
    vand,
    vfma,
    vge,
    vload,
    vmax,
    vmin,
    vselect,
    vstore,
    vsum,
)

_F = np.float32
_ALPHA_MIN, _ALPHA_MAX = _F(ALPHA_MIN), _F(ALPHA_MAX)
# Planes of the work: residual, colour behind the splat, transmittance there.
RESIDUAL, BEHIND, PASSING = 0, 3 * PIXELS, 6 * PIXELS


@kernel
def _start(residual, tile, tile_x, tile_y, background, transmittance, work):
    for channel in range(3):
        load_plane(residual, channel, tile_x, tile_y, work, RESIDUAL + channel * PIXELS)
    for at in range(0, PIXELS, 16):
        passed = vload(transmittance, tile * PIXELS + at)
        vstore(work, PASSING + at, passed)
        for channel in range(3):
            behind = passed * splat16(background[channel])
            vstore(work, BEHIND + channel * PIXELS + at, behind)


@kernel
def contribution_tiles(ticket, tiles, residual, out):
    """out [intersections, CONTRIBUTIONS] at each entry's slot; residual [3, H, W]: render less
    photograph."""
    width, height, tile_starts, members, slots, masks, geometry, paint = tiles[:8]
    background, transmittance, last = tiles[8:]
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(7 * PIXELS, np.float32)
    block_last = np.empty(BLOCKS, np.float32)
    lanes = np.empty(16, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        _start(residual, tile, tile_x, tile_y, background, transmittance, work)
        last_of_blocks(last, tile, block_last)
        start, end = tile_starts[tile], tile_starts[tile + 1]
        for entry in range(end - 1, start - 1, -1):
            number = _F(entry - start + 1)
            alive = bits16(vge(vload(block_last, 0), splat16(number)))
            _entry(
                tile_frame(geometry, members[entry], tile_x, tile_y),
                number,
                np.int64(masks[entry]) & alive,
                paint,
                members[entry],
                work,
                last,
                tile * PIXELS,
                lanes,
                out,
                slots[entry],
            )


@kernel
def _entry(frame, number, blocks, paint, row, work, last, last_at, lanes, out, slot):
    zero, one, two = splat16(_F(0.0)), splat16(_F(1.0)), splat16(_F(2.0))
    change, square = zero, zero
    total, largest, squares = zero, zero, zero
    residual_r, residual_g, residual_b = zero, zero, zero
    while blocks:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        at = 16 * block
        raw, _, _ = alpha_of(frame, block)
        drawn = vand(vge(raw, splat16(_ALPHA_MIN)), vge(vload(last, last_at + at), splat16(number)))
        alpha = vselect(drawn, vmin(raw, splat16(_ALPHA_MAX)), zero)
        inverse = one / (one - alpha)
        before = vload(work, PASSING + at) * inverse
        vstore(work, PASSING + at, before)
        weight = alpha * before
        total = total + weight
        largest = vmax(largest, weight)
        squares = vfma(weight, weight, squares)
        residual_r = vfma(weight, vload(work, RESIDUAL + at), residual_r)
        residual_g = vfma(weight, vload(work, RESIDUAL + PIXELS + at), residual_g)
        residual_b = vfma(weight, vload(work, RESIDUAL + 2 * PIXELS + at), residual_b)
        ratio = alpha * inverse
        for channel in range(3):
            plane = channel * PIXELS + at
            painted = weight * splat16(paint[row, channel])
            behind = vload(work, BEHIND + plane)
            shift = behind * ratio - painted
            change = vfma(shift, shift + two * vload(work, RESIDUAL + plane), change)
            square = vfma(shift, shift, square)
            vstore(work, BEHIND + plane, behind + painted)
    out[slot, ERROR_CHANGE], out[slot, PICTURE_CHANGE] = vsum(change), vsum(square)
    out[slot, WEIGHT], out[slot, SQUARED_WEIGHT] = vsum(total), vsum(squares)
    out[slot, WEIGHTED_RESIDUAL], out[slot, WEIGHTED_RESIDUAL + 1] = (
        vsum(residual_r),
        vsum(residual_g),
    )
    out[slot, WEIGHTED_RESIDUAL + 2] = vsum(residual_b)
    vstore(lanes, 0, largest)
    top = lanes[0]
    for lane in range(1, 16):
        top = max(top, lanes[lane])
    out[slot, LARGEST_WEIGHT] = top


@kernel
def gather_contributions(raw, places, out):
    """out [V, CONTRIBUTIONS] float64: sums (and the largest weight) over each visible splat's
    tiles."""
    for place in range(len(out)):
        for column in range(CONTRIBUTIONS):
            out[place, column] = 0.0
        first = places[place, SLOT]
        for slot in range(first, first + places[place, COUNT]):
            for column in range(CONTRIBUTIONS):
                value = np.float64(raw[slot, column])
                if column == LARGEST_WEIGHT:
                    out[place, column] = max(out[place, column], value)
                else:
                    out[place, column] += value
