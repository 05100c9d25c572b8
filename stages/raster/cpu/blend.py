"""Blending of a tile's splats from near to far, and its backward pass from far to near.

A tile has 16x16 pixels in blocks of 4x4; a block is one vector. A splat is drawn only in the blocks
that its ellipse touches. For each (splat, tile) the exponent is expressed in float64 around the
tile's first pixel, so that all float32 values are small:
    log2 alpha = log2 opacity - (A u)^2 - (B t)^2,
with u the pixel's offset along the axis of the larger variance and t across it. Both passes use
`alpha_of`: alpha must be the same to the last bit, because the backward pass divides by 1 - alpha.
"""

from __future__ import annotations

import numpy as np

from stages.raster.cpu.binning import BLOCK, TILE
from stages.raster.cpu.projection import (
    GA,
    GB,
    GEOMETRY_ROW,
    GK,
    GL,
    GVX,
    GVY,
    GX,
    GY,
    sums_origin,
)
from stages.raster.cpu.tile import (
    BLOCKS,
    PIXELS,
    last_of_blocks,
    load_plane,
    start_transmittance,
    store_plane,
)
from stages.raster.definition import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from stages.raster.kernels.simd import (
    bits16,
    kernel,
    lowest_bit,
    prefetch,
    splat16,
    store_sums8,
    take_ticket,
    vand,
    vany,
    vexp2,
    vfma,
    vfnma,
    vge,
    vgt,
    vload,
    vmax,
    vmin,
    vselect,
    vstore,
    vsum,
)

# Planes of a tile's work, forward and backward.
RED, GREEN, BLUE, ALPHA, DEPTH, MEDIAN, TRANSMITTANCE, LAST = (k * PIXELS for k in range(8))
V_RED, V_GREEN, V_BLUE, PASSING, BEHIND = (k * PIXELS for k in range(5))
# Results of the backward pass for a splat, sums over a tile's pixels: of v u, v t, v u^2, v t^2,
# v u t and v, with v the gradient with respect to a pixel's exponent; the three colours' gradients.
S_U, S_T, S_UU, S_TT, S_UT, S_1, S_RED = range(7)
SUMS = S_RED + 3
AHEAD = 6  # entries by which a splat's record is prefetched
_F = np.float32
_ALPHA_MIN, _ALPHA_MAX, _T_MIN = _F(ALPHA_MIN), _F(ALPHA_MAX), _F(TRANSMITTANCE_MIN)
_FAINTEST = _F(-115.0)  # log2 of alpha; `vexp2` is not valid much below
_HALF = _F(0.5)


def _offsets() -> tuple[np.ndarray, np.ndarray]:
    """Offsets from a tile's first pixel of a block's pixels (lanes) and of the blocks, along and
    across: [0] along x, [1] along y."""
    k = np.arange(16)
    lanes = np.stack([k % BLOCK, k // BLOCK]).astype(np.float32)
    return lanes.ravel(), (BLOCK * lanes).ravel()


_LANES, _STEPS = _offsets()


@kernel
def tile_frame(geometry, row, tile_x, tile_y):
    """The exponent of the splat `row` in coordinates around the tile's first pixel centre.

    Returns (major, A, B, -K, log2 opacity, U, T): major, 0 where the major axis is x, 16 where it
    is y; U, T: vectors of the first block's offsets along the major axis and across it.
    """
    dx = tile_x * TILE + 0.5 - geometry[row, GX]
    dy = tile_y * TILE + 0.5 - geometry[row, GY]
    k = geometry[row, GK]
    wide = geometry[row, GVX] >= geometry[row, GVY]
    major = 0 if wide else 16
    u = dx if wide else dy
    t = dy - k * dx if wide else dx - k * dy
    us, ts = _first_block(u, t, k, major)
    return (
        major,
        splat16(_F(geometry[row, GA])),
        splat16(_F(geometry[row, GB])),
        splat16(_F(-k)),
        splat16(_F(geometry[row, GL])),
        us,
        ts,
    )


@kernel
def _first_block(u, t, k, major):
    """Offsets of a tile's first block, from those of its first pixel."""
    along, across = vload(_LANES, major), vload(_LANES, 16 - major)
    return splat16(_F(u)) + along, splat16(_F(t)) + across - splat16(_F(k)) * along


@kernel
def _sums_frame(geometry, row, tile_x, tile_y, width, height):
    """The U and T of `tile_frame`, relative to the origin of the sums (`sums_origin`)."""
    o, p, q = sums_origin(geometry, row, width, height)
    x, y, k = tile_x * TILE + 0.5, tile_y * TILE + 0.5, geometry[row, GK]
    wide = geometry[row, GVX] >= geometry[row, GVY]
    major, minor = (x, y) if wide else (y, x)
    return _first_block(major - o, minor - q - k * (major - p), k, 0 if wide else 16)


@kernel
def alpha_of(frame, block):
    """(alpha before the cap, offsets along, offsets across) of the 16 pixels of a block.

    Offsets are relative to those of the first block.
    """
    major, a, b, slope, level, us, ts = frame
    along = splat16(_STEPS[major + block])
    across = vfma(slope, along, splat16(_STEPS[16 - major + block]))
    u, t = a * (us + along), b * (ts + across)
    level = vfnma(t, t, vfnma(u, u, level))
    return vexp2(vmax(level, splat16(_FAINTEST))), along, across


@kernel
def blend_tile(tile_x, tile_y, start, end, alive, members, masks, geometry, paint, depths, work):
    """Blend entries start..end of the lists into `work` (planes as above).

    alive: mask of the blocks with unfinished pixels. depths: whether to fill the depth planes.

    Rows of arrays are accessed by index, never sliced: a slice changes a reference count, which
    threads would contend for. Blocks without a drawn pixel are not skipped: a mispredicted branch
    costs more than a block.
    """
    zero, one = splat16(_F(0.0)), splat16(_F(1.0))
    for entry in range(start, end):
        blocks = np.int64(masks[entry]) & alive
        ahead = members[min(entry + AHEAD, end - 1)]
        prefetch(geometry, ahead * GEOMETRY_ROW)
        prefetch(paint, ahead * 4)
        if blocks == 0:
            continue
        row = members[entry]
        frame = tile_frame(geometry, row, tile_x, tile_y)
        r, g = splat16(paint[row, 0]), splat16(paint[row, 1])
        bl, z = splat16(paint[row, 2]), splat16(paint[row, 3])
        while blocks:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            at = 16 * block
            alpha, _, _ = alpha_of(frame, block)
            passing = vload(work, TRANSMITTANCE + at)
            drawn = vand(vge(alpha, splat16(_ALPHA_MIN)), vge(passing, splat16(_T_MIN)))
            alpha = vselect(drawn, vmin(alpha, splat16(_ALPHA_MAX)), zero)
            weight = alpha * passing
            left = passing * (one - alpha)
            vstore(work, TRANSMITTANCE + at, left)
            vstore(work, RED + at, vfma(weight, r, vload(work, RED + at)))
            vstore(work, GREEN + at, vfma(weight, g, vload(work, GREEN + at)))
            vstore(work, BLUE + at, vfma(weight, bl, vload(work, BLUE + at)))
            if depths:
                vstore(work, DEPTH + at, vfma(weight, z, vload(work, DEPTH + at)))
                halved = vand(vge(passing, splat16(_HALF)), vgt(splat16(_HALF), left))
                vstore(work, MEDIAN + at, vselect(halved, z, vload(work, MEDIAN + at)))
            finished = vand(vge(passing, splat16(_T_MIN)), vgt(splat16(_T_MIN), left))
            if vany(finished):
                number = splat16(_F(entry - start + 1))
                vstore(work, LAST + at, vselect(finished, number, vload(work, LAST + at)))
                if not vany(vge(left, splat16(_T_MIN))):
                    alive &= ~(np.int64(1) << block)
        if alive == 0:
            break


@kernel
def _finish_tile(background, depths, work):
    """Add the background, fill alpha, and turn sums of depths into means."""
    one, least = splat16(_F(1.0)), splat16(_F(0.5) * _ALPHA_MIN)
    for at in range(0, PIXELS, 16):
        passed = vload(work, TRANSMITTANCE + at)
        alpha = one - passed
        vstore(work, ALPHA + at, alpha)
        for channel in range(3):
            plane = channel * PIXELS + at
            behind = splat16(background[channel])
            vstore(work, plane, vfma(passed, behind, vload(work, plane)))
        if depths:
            vstore(work, DEPTH + at, vload(work, DEPTH + at) / vmax(alpha, least))


@kernel
def blend_tiles(ticket, tiles, depths, image):
    """Draw every tile. image [4 or 6, H, W] float32: red, green, blue, alpha; if `depths`, then
    expected and median depth.

    tiles: see `DrawnTiles`. Its transmittance and last [tiles, 256] float32, block by block, are
    filled for the backward pass: the final transmittance, and the number of the last entry drawn
    (NEVER where a pixel was not finished).
    """
    width, height, tile_starts, members, _, masks, geometry, paint = tiles[:8]
    background, transmittance, last = tiles[8:]
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(8 * PIXELS, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        work[:] = 0.0
        alive = start_transmittance(tile_x, tile_y, width, height, work, TRANSMITTANCE, LAST)
        start, end = tile_starts[tile], tile_starts[tile + 1]
        blend_tile(tile_x, tile_y, start, end, alive, members, masks, geometry, paint, depths, work)
        for at in range(0, PIXELS, 16):
            vstore(transmittance, tile * PIXELS + at, vload(work, TRANSMITTANCE + at))
            vstore(last, tile * PIXELS + at, vload(work, LAST + at))
        _finish_tile(background, depths, work)
        for channel in range(image.shape[0]):
            store_plane(image, channel, tile_x, tile_y, work, channel * PIXELS)


@kernel
def _start_gradient(v_image, tile, tile_x, tile_y, background, transmittance, work):
    for channel in range(3):
        load_plane(v_image, channel, tile_x, tile_y, work, channel * PIXELS)
    for at in range(0, PIXELS, 16):
        passed = vload(transmittance, tile * PIXELS + at)
        vstore(work, PASSING + at, passed)
        behind = vload(work, V_RED + at) * splat16(background[0])
        behind = vfma(vload(work, V_GREEN + at), splat16(background[1]), behind)
        behind = vfma(vload(work, V_BLUE + at), splat16(background[2]), behind)
        vstore(work, BEHIND + at, behind * passed)


@kernel
def blend_gradient_tiles(ticket, tiles, v_image, gradients):
    """gradients [intersections, SUMS] at each entry's slot, from v_image [3, H, W]."""
    width, height, tile_starts, members, slots, masks, geometry, paint = tiles[:8]
    background, transmittance, last = tiles[8:]
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(5 * PIXELS, np.float32)
    block_last = np.empty(BLOCKS, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        _start_gradient(v_image, tile, tile_x, tile_y, background, transmittance, work)
        furthest = last_of_blocks(last, tile, block_last)
        start, end = tile_starts[tile], tile_starts[tile + 1]
        for entry in range(end - 1, start - 1, -1):
            number = _F(entry - start + 1)
            if number > furthest:
                for k in range(SUMS):
                    gradients[slots[entry], k] = 0.0
                continue
            ahead = members[max(entry - AHEAD, start)]
            prefetch(geometry, ahead * GEOMETRY_ROW)
            prefetch(paint, ahead * 4)
            prefetch(gradients, slots[max(entry - AHEAD, start)] * SUMS)
            alive = bits16(vge(vload(block_last, 0), splat16(number)))
            entry_gradient(
                tile_frame(geometry, members[entry], tile_x, tile_y),
                _sums_frame(geometry, members[entry], tile_x, tile_y, width, height),
                number,
                np.int64(masks[entry]) & alive,
                paint,
                members[entry],
                work,
                last,
                tile * PIXELS,
                gradients,
                slots[entry],
            )


@kernel
def entry_gradient(
    frame, from_origin, number, blocks, paint, row, work, last, last_at, gradients, slot
):
    """Gradient of one splat in one tile into gradients[slot]: see SUMS; u and t from the origin
    of `sums_origin`.

    work: the incoming gradient; the transmittance behind the splat; the colour behind it times the
    incoming gradient (a suffix sum). The last two are updated to in front of the splat.
    """
    r, g, bl = splat16(paint[row, 0]), splat16(paint[row, 1]), splat16(paint[row, 2])
    zero, one = splat16(_F(0.0)), splat16(_F(1.0))
    v_u, v_t, v_uu, v_tt, v_ut, v_1 = zero, zero, zero, zero, zero, zero
    s_r, s_g, s_b = zero, zero, zero
    us, ts = from_origin
    while blocks:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        at = 16 * block
        raw, along, across = alpha_of(frame, block)
        drawn = vand(vge(raw, splat16(_ALPHA_MIN)), vge(vload(last, last_at + at), splat16(number)))
        alpha = vselect(drawn, vmin(raw, splat16(_ALPHA_MAX)), zero)
        inverse = one / (one - alpha)
        before = vload(work, PASSING + at) * inverse
        vstore(work, PASSING + at, before)
        weight = alpha * before
        vr, vg, vb = vload(work, V_RED + at), vload(work, V_GREEN + at), vload(work, V_BLUE + at)
        s_r = vfma(weight, vr, s_r)
        s_g = vfma(weight, vg, s_g)
        s_b = vfma(weight, vb, s_b)
        shade = vfma(vr, r, vfma(vg, g, vb * bl))
        after = vload(work, BEHIND + at)
        vstore(work, BEHIND + at, vfma(weight, shade, after))
        v = alpha * (after * inverse - before * shade)
        v = vselect(vgt(splat16(_ALPHA_MAX), raw), v, zero)  # no gradient where alpha is capped
        u, t = us + along, ts + across
        by_u, by_t = v * u, v * t
        v_1 = v_1 + v
        v_u = v_u + by_u
        v_t = v_t + by_t
        v_uu = vfma(by_u, u, v_uu)
        v_tt = vfma(by_t, t, v_tt)
        v_ut = vfma(by_u, t, v_ut)
    store_sums8(gradients, slot * SUMS, v_u, v_t, v_uu, v_tt, v_ut, v_1, s_r, s_g)
    gradients[slot, S_RED + 2] = vsum(s_b)
