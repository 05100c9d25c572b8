"""Blending the splats of a tile, near to far, and the gradient back through it, far to near.

A tile is 16x16 pixels; a row of it is one vector. Per (splat, tile) the exponent is rewritten in
float64 around the tile's first pixel, so that everything that runs in float32 is small:
    log2 alpha(i, j) = log2 opacity - (A (u + i or j)^2 + B (M_i + m j)^2) / ln 2,
u along the axis of the larger variance. `alpha_row` is the one function for both directions:
alpha must be the same to the last bit, since the way back divides by 1 - alpha.
"""

from __future__ import annotations

import numpy as np

from stages.raster.api import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from stages.raster.binning import TILE
from stages.raster.projection import GA, GB, GK, GL, GVX, GVY, GX, GY
from stages.raster.simd import (
    iota16,
    kernel,
    splat16,
    store_sums8,
    take_ticket,
    vand,
    vany,
    vexp2,
    vfma,
    vge,
    vgt,
    vload,
    vmax,
    vmin,
    vselect,
    vstore,
    vsum,
)

PIXELS = TILE * TILE
# Planes of a tile's work, forward and backward.
LIGHT, RED, GREEN, BLUE, DEPTH, MEDIAN, LAST = (k * PIXELS for k in range(7))
V_RED, V_GREEN, V_BLUE, PASSING, BEHIND = (k * PIXELS for k in range(5))
NEVER = np.float32(3e38)  # "last" of a pixel that is not finished
_LOG2E = 1.4426950408889634
_F = np.float32
_ALPHA_MIN, _ALPHA_MAX, _T_MIN = _F(ALPHA_MIN), _F(ALPHA_MAX), _F(TRANSMITTANCE_MIN)
_FAINTEST = _F(-115.0)  # log2 of alpha: below it `vexp2` would leave its range
_HALF = _F(0.5)


@kernel
def tile_frame(geometry, row, tile_x, tile_y):
    """The record of a row around the tile's first pixel centre.

    Returns (wide, A', B', K, log2 opacity, u, m): wide, whether the major axis is x; A', B': of
    the exponent to base 2, negative; u: offset of the first pixel along the major axis; m: offset
    across less K u.
    """
    dx = tile_x * TILE + 0.5 - geometry[row, GX]
    dy = tile_y * TILE + 0.5 - geometry[row, GY]
    k = geometry[row, GK]
    wide = geometry[row, GVX] >= geometry[row, GVY]
    u = dx if wide else dy
    m = dy - k * dx if wide else dx - k * dy
    return (
        wide,
        _F(geometry[row, GA] * -_LOG2E),
        _F(geometry[row, GB] * -_LOG2E),
        _F(k),
        _F(geometry[row, GL]),
        _F(u),
        _F(m),
    )


@kernel
def exponent_parts(wide, a, k, log_opacity, u, m):
    """The level log2 alpha is Q + P (U + j)^2 + B' (M + S j)^2 in row j of the tile.

    Returns the vectors (Q, P, U, M, S).
    """
    i, zero = iota16(), splat16(_F(0.0))
    level = splat16(log_opacity)
    if wide:
        us = splat16(u) + i
        q = vfma(splat16(a) * us, us, level)
        return q, zero, zero, splat16(m) - splat16(k) * i, splat16(_F(1.0))
    return level, splat16(a), splat16(u), splat16(m) + i, splat16(-k)


@kernel
def alpha_row(parts, b, j):
    """Alpha, before the cap, of row j of pixels."""
    q, p, u, m, s = parts
    row = splat16(_F(j))
    along, across = u + row, vfma(s, row, m)
    level = vfma(b * across, across, vfma(p * along, along, q))
    return vexp2(vmax(level, splat16(_FAINTEST)))


@kernel
def start_light(light, tile_x, tile_y, width, height):
    """1 in the tile's pixels that lie in the picture, 0 in those beyond its rim."""
    for j in range(TILE):
        for i in range(TILE):
            inside = tile_x * TILE + i < width and tile_y * TILE + j < height
            light[j * TILE + i] = _F(1.0) if inside else _F(0.0)


@kernel
def _light_is_left(work):
    most = vload(work, 0)
    for j in range(1, TILE):
        most = vmax(most, vload(work, j * TILE))
    return vany(vge(most, splat16(_T_MIN)))


@kernel
def blend_tile(tile_x, tile_y, start, end, members, spans, geometry, paint, depths, work):
    """Blend entries start..end of the lists into `work` (planes as above).

    Rows of arrays are reached by index, never sliced: a slice counts references, and threads would
    fight over the counter. depths: whether the depth planes are wanted.
    """
    zero, one = splat16(_F(0.0)), splat16(_F(1.0))
    for entry in range(start, end):
        if (entry - start) % 16 == 15 and not _light_is_left(work):
            break
        row = members[entry]
        wide, a, b, k, log_opacity, u, m = tile_frame(geometry, row, tile_x, tile_y)
        parts = exponent_parts(wide, a, k, log_opacity, u, m)
        b_all = splat16(b)
        r, g = splat16(paint[row, 0]), splat16(paint[row, 1])
        bl, z = splat16(paint[row, 2]), splat16(paint[row, 3])
        number = splat16(_F(entry - start + 1))
        for j in range(spans[entry] & 15, (spans[entry] >> 4) + 1):
            at = j * TILE
            alpha = alpha_row(parts, b_all, j)
            passing = vload(work, LIGHT + at)
            drawn = vand(vge(alpha, splat16(_ALPHA_MIN)), vge(passing, splat16(_T_MIN)))
            alpha = vselect(drawn, vmin(alpha, splat16(_ALPHA_MAX)), zero)
            weight = alpha * passing
            left = passing * (one - alpha)
            vstore(work, LIGHT + at, left)
            vstore(work, RED + at, vfma(weight, r, vload(work, RED + at)))
            vstore(work, GREEN + at, vfma(weight, g, vload(work, GREEN + at)))
            vstore(work, BLUE + at, vfma(weight, bl, vload(work, BLUE + at)))
            finished = vand(drawn, vgt(splat16(_T_MIN), left))
            if vany(finished):
                vstore(work, LAST + at, vselect(finished, number, vload(work, LAST + at)))
            if depths:
                vstore(work, DEPTH + at, vfma(weight, z, vload(work, DEPTH + at)))
                halved = vand(vge(passing, splat16(_HALF)), vgt(splat16(_HALF), left))
                vstore(work, MEDIAN + at, vselect(halved, z, vload(work, MEDIAN + at)))


@kernel
def blend_tiles(
    ticket,
    width,
    height,
    tile_starts,
    members,
    spans,
    geometry,
    paint,
    background,
    depths,
    image,
    light,
    last,
):
    """Draw every tile. image [4 or 6, H, W] float32: red, green, blue, alpha; if `depths`, then
    expected and median depth.

    light, last [tiles, 256] float32: what the way back needs: the light that passes at the end and
    the number of the last entry drawn, NEVER where a pixel was not finished.
    """
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(7 * PIXELS, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        work[:] = 0.0
        start_light(work, tile_x, tile_y, width, height)
        for at in range(PIXELS):
            work[LAST + at] = NEVER
        start, end = tile_starts[tile], tile_starts[tile + 1]
        blend_tile(tile_x, tile_y, start, end, members, spans, geometry, paint, depths, work)
        for at in range(PIXELS):
            light[tile, at] = work[LIGHT + at]
            last[tile, at] = work[LAST + at]
        for j in range(min(TILE, height - tile_y * TILE)):
            y = tile_y * TILE + j
            for i in range(min(TILE, width - tile_x * TILE)):
                x, at = tile_x * TILE + i, j * TILE + i
                passed = work[LIGHT + at]
                image[0, y, x] = work[RED + at] + passed * background[0]
                image[1, y, x] = work[GREEN + at] + passed * background[1]
                image[2, y, x] = work[BLUE + at] + passed * background[2]
                image[3, y, x] = _F(1.0) - passed
                if depths:
                    hit = max(_F(1.0) - passed, _F(0.5) * _ALPHA_MIN)
                    image[4, y, x] = work[DEPTH + at] / hit
                    image[5, y, x] = work[MEDIAN + at]


@kernel
def furthest_entry(last, tile, width, height, entries):
    """How many of a tile's entries were drawn at all: none behind the last pixel's last."""
    tiles_x = (width + TILE - 1) // TILE
    furthest = _F(0.0)
    for j in range(min(TILE, height - tile // tiles_x * TILE)):
        for i in range(min(TILE, width - tile % tiles_x * TILE)):
            furthest = max(furthest, last[tile, j * TILE + i])
    return entries if furthest >= entries else np.int64(furthest)


@kernel
def blend_gradient_tiles(
    ticket,
    width,
    height,
    tile_starts,
    members,
    slots,
    spans,
    geometry,
    paint,
    background,
    light,
    last,
    v_image,
    gradients,
):
    """gradients [intersections, 9] at each entry's slot, from v_image [3, H, W]."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(5 * PIXELS, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        work[:] = 0.0
        for j in range(min(TILE, height - tile_y * TILE)):
            y = tile_y * TILE + j
            for i in range(min(TILE, width - tile_x * TILE)):
                x, at = tile_x * TILE + i, j * TILE + i
                vr, vg, vb = v_image[0, y, x], v_image[1, y, x], v_image[2, y, x]
                passed = light[tile, at]
                work[V_RED + at], work[V_GREEN + at], work[V_BLUE + at] = vr, vg, vb
                work[PASSING + at] = passed
                work[BEHIND + at] = passed * (
                    vr * background[0] + vg * background[1] + vb * background[2]
                )
        start, end = tile_starts[tile], tile_starts[tile + 1]
        drawn_end = start + furthest_entry(last, tile, width, height, end - start)
        for entry in range(drawn_end, end):
            for k in range(9):
                gradients[slots[entry], k] = 0.0
        for entry in range(drawn_end - 1, start - 1, -1):
            entry_gradient(
                tile_x,
                tile_y,
                _F(entry - start + 1),
                spans[entry],
                geometry,
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
    tile_x, tile_y, number, span, geometry, paint, row, work, last, last_at, gradients, slot
):
    """Gradient of one splat in one tile into gradients[slot, :9].

    With v the gradient that reaches the exponent of a pixel, u and t its offsets along and across
    the splat's major axis, the sums over pixels of: v u, v t, v u^2, v t^2, v u t, v, and of the
    gradients of red, green and blue.

    Only sums of v, v j, v j^2 per column are carried through the rows, j counted from the middle
    row: u and t are affine in j.

    work: the incoming gradient, the light that passes behind the splat, and what lies behind
    weighted by the incoming gradient (a suffix sum). The last two move in front of it.
    """
    wide, a, b, k, log_opacity, u, m = tile_frame(geometry, row, tile_x, tile_y)
    parts = exponent_parts(wide, a, k, log_opacity, u, m)
    b_all = splat16(b)
    r, g, bl = splat16(paint[row, 0]), splat16(paint[row, 1]), splat16(paint[row, 2])
    zero, one = splat16(_F(0.0)), splat16(_F(1.0))
    s_0, s_1, s_2 = zero, zero, zero
    s_r, s_g, s_b = zero, zero, zero
    middle = ((span & 15) + (span >> 4)) // 2
    for j in range(span & 15, (span >> 4) + 1):
        at = j * TILE
        raw = alpha_row(parts, b_all, j)
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
        v = vselect(vgt(splat16(_ALPHA_MAX), raw), v, zero)  # the cap passes nothing on
        step = splat16(_F(j - middle))
        s_0 = s_0 + v
        s_1 = vfma(v, step, s_1)
        s_2 = vfma(v * step, step, s_2)
    i, centre = iota16(), _F(middle)
    if wide:
        us, ts = splat16(u) + i, parts[3] + splat16(centre)
        v_u, v_uu = us * s_0, us * us * s_0
        v_t = vfma(ts, s_0, s_1)
        v_tt = vfma(ts, v_t + s_1, s_2)
        v_ut = us * v_t
    else:
        us, ts = splat16(u + centre), parts[3] - splat16(k * centre)
        slope = splat16(k)
        v_u = vfma(us, s_0, s_1)
        v_uu = vfma(us, v_u + s_1, s_2)
        v_t = ts * s_0 - slope * s_1
        v_tt = ts * (v_t - slope * s_1) + slope * slope * s_2
        v_ut = ts * v_u - slope * vfma(us, s_1, s_2)
    store_sums8(gradients, slot * 9, v_u, v_t, v_uu, v_tt, v_ut, s_0, s_r, s_g)
    gradients[slot, 8] = vsum(s_b)
