"""Lists of the splats of each tile, nearest first: the kernels between torch's sorts.

A splat's tiles are found row of tiles by row of tiles, from its ellipse. How many they are is
counted first; then each entry of the lists finds its splat by bisection, so that a splat of
thousands of tiles is the work of thousands of lanes. Counting and finding compute the same spans:
both kernels are compiled without fused multiply-adds, which a compiler places as it likes.
"""

from __future__ import annotations

import triton
import triton.language as tl

from stages.raster.gpu.geometry import LOG_SCALE, MEAN, OPACITY, ROTATION, SH
from stages.raster.gpu.inner import inner, top_of
from stages.raster.gpu.project import (
    S_FIRST,
    S_HALF_X,
    S_HALF_Y,
    S_LAST,
    S_RHO,
    S_THIN,
    S_X,
    S_Y,
    SHAPE,
)

LONGEST_RUN = tl.constexpr(1024)  # of equal depths that are put in order


@inner
def shape_of(shapes, row, mask):
    """(x, y, half_x, half_y, rho, thin) of splats; see `project`."""
    at = shapes + row * SHAPE
    x, y = tl.load(at + S_X, mask=mask, other=0.0), tl.load(at + S_Y, mask=mask, other=0.0)
    half_x = tl.load(at + S_HALF_X, mask=mask, other=1.0)
    half_y = tl.load(at + S_HALF_Y, mask=mask, other=1.0)
    rho = tl.load(at + S_RHO, mask=mask, other=0.0)
    thin = tl.load(at + S_THIN, mask=mask, other=0.0)
    return x, y, half_x, half_y, rho, thin


@inner
def row_span(x, y, half_x, half_y, rho, thin, tile_row, width, tile):
    """(first, number) of the tiles that an ellipse touches in a row of tiles.

    With eta the height in half boxes, the ellipse ends at rho eta +- thin sqrt(1 - eta^2), which
    is furthest out at +-rho. A hair more is taken than rounding could lose.
    """
    top = tile_row * tile + 0.5
    low = tl.minimum(tl.maximum((top - y) / half_y - 1e-5, -1.0), 1.0)
    high = tl.minimum(tl.maximum((top + (tile - 1.0) - y) / half_y + 1e-5, -1.0), 1.0)
    out_right = tl.minimum(tl.maximum(rho, low), high)
    out_left = tl.minimum(tl.maximum(-rho, low), high)
    wide_right = thin * tl.sqrt(tl.maximum(1.0 - out_right * out_right, 0.0))
    wide_left = thin * tl.sqrt(tl.maximum(1.0 - out_left * out_left, 0.0))
    slack = 1e-3 + 1e-5 * half_x + 1e-6 * tl.abs(x)
    right = x + half_x * (rho * out_right + wide_right) + slack - 0.5
    left = x + half_x * (rho * out_left - wide_left) - slack - 0.5
    end = width - 1.0
    first = tl.minimum(tl.maximum(left, 0.0), end).to(tl.int32) // tile
    last = tl.minimum(tl.maximum(right, 0.0), end).to(tl.int32) // tile
    touches = (right >= 0.0) & (left <= end)
    return first, tl.where(touches, last - first + 1, 0)


@triton.jit(do_not_specialize=["n", "width", "tile"])
def count_kernel(shapes, keys, counts, n, width, tile, BLOCK: tl.constexpr):
    """counts [n] int32: number of tiles that each splat touches, 0 if it is not visible."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    shown = tl.load(keys + i, mask=mask, other=float("inf")) < float("inf")
    x, y, half_x, half_y, rho, thin = shape_of(shapes, i, shown)
    first = tl.load(shapes + i * SHAPE + S_FIRST, mask=shown, other=0.0)
    last = tl.load(shapes + i * SHAPE + S_LAST, mask=shown, other=-1.0)
    total = (i * 0).to(tl.int32)
    most = top_of(last - first, 0)
    step = most * 0.0
    while step <= most:
        tile_row = first + step
        _, tiles = row_span(x, y, half_x, half_y, rho, thin, tile_row, width, tile)
        total += tl.where(tile_row <= last, tiles, 0)
        step += 1.0
    tl.store(counts + i, total, mask=mask)


@triton.jit(
    do_not_specialize=["n", "tiles_x", "tiles", "width", "tile", "capacity", "largest_step"]
)
def entries_kernel(
    shapes,
    order,
    ends,
    n,
    tiles_x,
    tiles,
    width,
    tile,
    capacity,
    largest_step,
    tile_of,
    row_of,
    BLOCK: tl.constexpr,
):
    """tile_of, row_of [capacity]: the tile and the splat of each entry, splats nearest first; the
    number of tiles beyond the last entry. order [n]: rows, nearest first; ends [n]: of their
    entries. largest_step: a power of two above n."""
    e = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    low = e * 0  # the number of splats whose entries end at or before e
    step = largest_step
    while step > 0:
        probe = low + step
        inside = probe <= n
        end = tl.load(ends + probe - 1, mask=inside, other=0)
        low = tl.where(inside & (end <= e), probe, low)
        step = step // 2
    there = (low < n) & (e < capacity)
    row = tl.load(order + low, mask=there, other=0)
    before = tl.load(ends + low - 1, mask=there & (low > 0), other=0)
    left = (e - before).to(tl.int32)
    x, y, half_x, half_y, rho, thin = shape_of(shapes, row, there)
    tile_row = tl.load(shapes + row * SHAPE + S_FIRST, mask=there, other=0.0)
    last = tl.load(shapes + row * SHAPE + S_LAST, mask=there, other=-1.0)
    found = left * 0 + tiles
    searching = there
    while top_of(searching.to(tl.int32), 0) > 0:
        first, count = row_span(x, y, half_x, half_y, rho, thin, tile_row, width, tile)
        here = searching & (left < count)
        found = tl.where(here, tile_row.to(tl.int32) * tiles_x + first + left, found)
        left -= count
        tile_row += 1.0
        searching = searching & (tile_row <= last) & (found == tiles)
    tl.store(tile_of + e, found.to(tile_of.dtype.element_ty), mask=e < capacity)
    tl.store(row_of + e, row.to(tl.int32), mask=e < capacity)


@inner
def compared(rows, a, b, mask, k, sign, columns):
    """`sign`; where that is 0, the sign of column k of rows a minus column k of rows b."""
    x = tl.load(rows + a * columns + k, mask=mask, other=0.0)
    y = tl.load(rows + b * columns + k, mask=mask, other=0.0)
    here = (x > y).to(tl.int32) - (x < y).to(tl.int32)
    return tl.where(sign == 0, here, sign)


@inner
def order_of(rows, a, b, mask, columns, used):
    """-1 where rows a come before rows b, 1 where after, 0 where equal: by mean, opacity,
    scales, rotation and SH, as in `reference`."""
    sign = (a * 0).to(tl.int32)
    for k in tl.static_range(3):
        sign = compared(rows, a, b, mask, MEAN + k, sign, columns)
    if top_of((mask & (sign == 0)).to(tl.int32), 0) > 0:
        sign = compared(rows, a, b, mask, OPACITY, sign, columns)
        for axis in tl.static_range(3):
            sign = compared(rows, a, b, mask, LOG_SCALE + axis, sign, columns)
        for part in tl.static_range(4):
            sign = compared(rows, a, b, mask, ROTATION + part, sign, columns)
        for at in range(SH, used):
            sign = compared(rows, a, b, mask, at, sign, columns)
    return sign


@triton.jit(do_not_specialize=["n", "columns", "used"])
def ties_kernel(keys, order, ordered, rows, n, columns, used, BLOCK: tl.constexpr):
    """ordered [n]: `order`, with runs of equal finite keys in the order of the splats' own values.

    keys [n]: sorted. A splat moves up by those before it that belong behind it, and down by those
    behind it that belong before it. Runs of more than LONGEST_RUN splats stay in the order of rows:
    work grows with the square of a run's length, and a million splats at one depth would never end.
    """
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    key = tl.load(keys + i, mask=mask, other=float("inf"))
    row = tl.load(order + i, mask=mask, other=0)
    place, length = i, i * 0 + 1
    for side in tl.static_range(2):
        way = 2 * side - 1
        rival = i + way
        tied = mask & (key < float("inf"))
        seen = 0
        while (top_of(tied.to(tl.int32), 0) > 0) & (seen < LONGEST_RUN):
            tied = tied & (rival >= 0) & (rival < n)
            tied = tied & (tl.load(keys + rival, mask=tied, other=float("inf")) == key)
            rival_row = tl.load(order + rival, mask=tied, other=0)
            wrong = order_of(rows, rival_row, row, tied, columns, used) * way < 0
            place += tl.where(tied & wrong, way, 0)
            length += tied.to(tl.int64)
            rival += way
            seen += 1
    tl.store(ordered + tl.where(length > LONGEST_RUN, i, place), row, mask=mask)
