"""Blending the splats of a tile, near to far, and the gradient back through it, far to near.

A tile is 16x16 pixels; a row of it is one vector. Per (splat, tile) the exponent is rewritten in
float64 around the tile's first pixel, so that everything that runs in float32 is small:
    exponent(i, j) = A (u + i or j)^2 + B (M_i + m j)^2,
u along the axis of the larger variance. `exponent_row` is the one function for both directions:
alpha must be the same to the last bit, since the way back divides by 1 - alpha.
"""

from __future__ import annotations

import numpy as np

from stages.raster.api import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from stages.raster.binning import TILE
from stages.raster.projection import GA, GB, GK, GO, GVX, GVY, GX, GY
from stages.raster.simd import (
    iota16,
    kernel,
    splat16,
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
# Planes of a tile's work row, and of the gradient's.
LIGHT, RED, GREEN, BLUE, DEPTH, LAST = (k * PIXELS for k in range(6))
V_RED, V_GREEN, V_BLUE, PASSING, BEHIND = (k * PIXELS for k in range(5))
GRADIENTS = 9  # mean along the major axis, along the minor, A, B, K, opacity, red, green, blue
_LOG2E = 1.4426950408889634
_F = np.float32
_ALPHA_MIN, _ALPHA_MAX, _T_MIN = _F(ALPHA_MIN), _F(ALPHA_MAX), _F(TRANSMITTANCE_MIN)
_CUT = _F(80.0)  # exponents beyond it (alpha 2e-35) would leave the range of `vexp2`


@kernel
def tile_frame(geometry, rank, tile_x, tile_y):
    """The record of a rank around the tile's first pixel centre.

    Returns (wide, A, B, K, opacity, u, m): wide, whether the major axis is x; u: offset of the
    first pixel along the major axis; m: offset across less K u.
    """
    dx = tile_x * TILE + 0.5 - geometry[rank, GX]
    dy = tile_y * TILE + 0.5 - geometry[rank, GY]
    k = geometry[rank, GK]
    wide = geometry[rank, GVX] >= geometry[rank, GVY]
    u = dx if wide else dy
    m = dy - k * dx if wide else dx - k * dy
    return (
        wide,
        _F(geometry[rank, GA]),
        _F(geometry[rank, GB]),
        _F(k),
        _F(geometry[rank, GO]),
        _F(u),
        _F(m),
    )


@kernel
def column_parts(wide, a, k, u, m):
    """What does not depend on the row: (u per column, A u^2 per column, M per column)."""
    i = iota16()
    if wide:
        us = splat16(u) + i
        return us, splat16(a) * us * us, splat16(m) - splat16(k) * i
    zero = splat16(_F(0.0))
    return zero, zero, splat16(m) + i


@kernel
def row_parts(wide, a, k, u, j):
    """What does not depend on the column: (u, A u^2, m j)."""
    if wide:
        return _F(0.0), _F(0.0), _F(j)
    uj = u + _F(j)
    return uj, a * uj * uj, -k * _F(j)


@kernel
def alpha_row(b, opacity, columns_q, columns_m, row_q, row_m):
    """(alpha before the cap, falloff exp(-exponent), distance across) of one row of pixels."""
    across = columns_m + splat16(row_m)
    exponent = vfma(splat16(b) * across, across, columns_q + splat16(row_q))
    falloff = vexp2(vmin(exponent, splat16(_CUT)) * splat16(_F(-_LOG2E)))
    return splat16(opacity) * falloff, falloff, across


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
def blend_tile(tile_x, tile_y, start, end, ranks, rows, geometry, paint, work):
    """Blend entries start..end into work[6 x 256]: light, red, green, blue, depth, last entry.

    Rows of arrays are reached by index, never sliced: a slice counts references, and threads would
    fight over the counter.

    paint [visible, 4] float32: red, green, blue, depth of each splat.
    """
    zero = splat16(_F(0.0))
    for entry in range(start, end):
        if (entry - start) % 16 == 15 and not _light_is_left(work):
            break
        rank = ranks[entry]
        wide, a, b, k, opacity, u, m = tile_frame(geometry, rank, tile_x, tile_y)
        _, columns_q, columns_m = column_parts(wide, a, k, u, m)
        number = splat16(_F(entry - start + 1))
        r, g = splat16(paint[rank, 0]), splat16(paint[rank, 1])
        bl, z = splat16(paint[rank, 2]), splat16(paint[rank, 3])
        for j in range(rows[entry] & 15, (rows[entry] >> 4) + 1):
            at = j * TILE
            _, row_q, row_m = row_parts(wide, a, k, u, j)
            alpha, _, _ = alpha_row(b, opacity, columns_q, columns_m, row_q, row_m)
            passing = vload(work, LIGHT + at)
            drawn = vand(vge(alpha, splat16(_ALPHA_MIN)), vge(passing, splat16(_T_MIN)))
            if vany(drawn):
                alpha = vselect(drawn, vmin(alpha, splat16(_ALPHA_MAX)), zero)
                weight = alpha * passing
                vstore(work, LIGHT + at, passing * (splat16(_F(1.0)) - alpha))
                vstore(work, RED + at, vfma(weight, r, vload(work, RED + at)))
                vstore(work, GREEN + at, vfma(weight, g, vload(work, GREEN + at)))
                vstore(work, BLUE + at, vfma(weight, bl, vload(work, BLUE + at)))
                vstore(work, DEPTH + at, vfma(weight, z, vload(work, DEPTH + at)))
                vstore(work, LAST + at, vselect(drawn, number, vload(work, LAST + at)))


@kernel
def blend_tiles(
    ticket, width, height, tile_starts, ranks, rows, geometry, paint, background, image, light, last
):
    """Draw every tile. image [5, H, W] float32: red, green, blue, alpha, expected depth.

    light, last [tiles, 256] float32: what the way back needs: the light that passes at the end and
    the number of the last entry drawn.
    """
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(6 * PIXELS, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        work[:] = 0.0
        start_light(work, tile_x, tile_y, width, height)
        start, end = tile_starts[tile], tile_starts[tile + 1]
        blend_tile(tile_x, tile_y, start, end, ranks, rows, geometry, paint, work)
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
                image[4, y, x] = work[DEPTH + at] / max(_F(1.0) - passed, _F(0.5) * _ALPHA_MIN)


@kernel
def blend_gradient_tiles(
    ticket,
    width,
    height,
    tile_starts,
    ranks,
    slots,
    rows,
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
        furthest = _F(0.0)
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
                furthest = max(furthest, last[tile, at])
        start, end = tile_starts[tile], tile_starts[tile + 1]
        drawn_end = start + np.int64(furthest)
        for entry in range(drawn_end, end):
            for k in range(GRADIENTS):
                gradients[slots[entry], k] = 0.0
        for entry in range(drawn_end - 1, start - 1, -1):
            entry_gradient(
                tile_x,
                tile_y,
                _F(entry - start + 1),
                rows[entry],
                geometry,
                paint,
                ranks[entry],
                work,
                last,
                tile * PIXELS,
                gradients,
                slots[entry],
            )


@kernel
def entry_gradient(
    tile_x,
    tile_y,
    number,
    row_range,
    geometry,
    paint,
    rank,
    work,
    last,
    last_at,
    gradients,
    slot,
):
    """Gradient of one splat in one tile into gradients[slot, :9].

    work [5 x 256]: the incoming gradient, the light that passes behind the splat, and what lies
    behind weighted by the incoming gradient (a suffix sum). The last two move in front of it.
    """
    wide, a, b, k, opacity, u, m = tile_frame(geometry, rank, tile_x, tile_y)
    columns_u, columns_q, columns_m = column_parts(wide, a, k, u, m)
    r, g, bl = splat16(paint[rank, 0]), splat16(paint[rank, 1]), splat16(paint[rank, 2])
    zero, one = splat16(_F(0.0)), splat16(_F(1.0))
    s_u, s_uu, s_t, s_tt, s_ut = zero, zero, zero, zero, zero
    s_o, s_r, s_g, s_b = zero, zero, zero, zero
    for j in range(row_range & 15, (row_range >> 4) + 1):
        at = j * TILE
        row_u, row_q, row_m = row_parts(wide, a, k, u, j)
        raw, falloff, across = alpha_row(b, opacity, columns_q, columns_m, row_q, row_m)
        drawn = vand(vge(raw, splat16(_ALPHA_MIN)), vge(vload(last, last_at + at), splat16(number)))
        if not vany(drawn):
            continue
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
        v_alpha = before * shade - after * inverse
        free = vand(drawn, vgt(splat16(_ALPHA_MAX), raw))  # the cap passes nothing on
        v_alpha = vselect(free, v_alpha, zero)
        s_o = vfma(v_alpha, falloff, s_o)
        v_exponent = zero - v_alpha * alpha
        us = columns_u + splat16(row_u)
        by_u, by_t = v_exponent * us, v_exponent * across
        s_u = s_u + by_u
        s_uu = vfma(by_u, us, s_uu)
        s_t = s_t + by_t
        s_tt = vfma(by_t, across, s_tt)
        s_ut = vfma(by_t, us, s_ut)
    t_sum = vsum(s_t)
    gradients[slot, 0] = _F(2.0) * (b * k * t_sum - a * vsum(s_u))
    gradients[slot, 1] = _F(-2.0) * b * t_sum
    gradients[slot, 2] = vsum(s_uu)
    gradients[slot, 3] = vsum(s_tt)
    gradients[slot, 4] = _F(-2.0) * b * vsum(s_ut)
    gradients[slot, 5] = vsum(s_o)
    gradients[slot, 6], gradients[slot, 7] = vsum(s_r), vsum(s_g)
    gradients[slot, 8] = vsum(s_b)
