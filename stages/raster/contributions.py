"""What each splat is worth to a picture: its weights, and the exact change of the squared error if
it were removed.

Colour is affine in each alpha, so removing one splat changes a pixel by
    dI = -w c + behind alpha / (1 - alpha),
w its blend weight, c its colour, "behind" what is composited behind it (background included, light
at its place included); the squared error against a photograph changes by 2 r dI + dI^2, r the
residual. Exact but for pixels that the stopping rule or the alpha cut-off would treat otherwise.
"""

from __future__ import annotations

import numpy as np

from stages.raster.api import ALPHA_MAX, ALPHA_MIN
from stages.raster.binning import TILE
from stages.raster.blend import (
    PIXELS,
    alpha_row,
    exponent_parts,
    furthest_entry,
    tile_frame,
)
from stages.raster.simd import (
    kernel,
    splat16,
    take_ticket,
    vand,
    vany,
    vfma,
    vge,
    vload,
    vmax,
    vmin,
    vselect,
    vstore,
    vsum,
)

COLUMNS = 3  # change of the squared error, sum of weights, largest weight
_F = np.float32
_ALPHA_MIN, _ALPHA_MAX = _F(ALPHA_MIN), _F(ALPHA_MAX)
# Planes of the work row: residual, light behind the splat, colour behind it.
RESIDUAL, PASSING, BEHIND = 0, 3 * PIXELS, 4 * PIXELS


@kernel
def contribution_tiles(
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
    residual,
    out,
):
    """out [intersections, 3] at each entry's slot; residual [3, H, W]: render - photograph."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    work = np.empty(7 * PIXELS, np.float32)
    lanes = np.empty(16, np.float32)
    while True:
        tile = take_ticket(ticket)
        if tile >= tiles_x * tiles_y:
            break
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        work[:] = 0.0
        for j in range(min(TILE, height - tile_y * TILE)):
            for i in range(min(TILE, width - tile_x * TILE)):
                at = j * TILE + i
                work[PASSING + at] = light[tile, at]
                for channel in range(3):
                    r = residual[channel, tile_y * TILE + j, tile_x * TILE + i]
                    work[RESIDUAL + channel * PIXELS + at] = r
                    work[BEHIND + channel * PIXELS + at] = light[tile, at] * background[channel]
        start, end = tile_starts[tile], tile_starts[tile + 1]
        drawn_end = start + furthest_entry(last, tile, width, height, end - start)
        for entry in range(drawn_end, end):
            for k in range(COLUMNS):
                out[slots[entry], k] = 0.0
        for entry in range(drawn_end - 1, start - 1, -1):
            _entry(
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
                lanes,
                out,
                slots[entry],
            )


@kernel
def _entry(
    tile_x,
    tile_y,
    number,
    span,
    geometry,
    paint,
    row,
    work,
    last,
    last_at,
    lanes,
    out,
    slot,
):
    wide, a, b, k, log_opacity, u, m = tile_frame(geometry, row, tile_x, tile_y)
    parts = exponent_parts(wide, a, k, log_opacity, u, m)
    zero, one, two = splat16(_F(0.0)), splat16(_F(1.0)), splat16(_F(2.0))
    change, total, largest = zero, zero, zero
    for j in range(span & 15, (span >> 4) + 1):
        at = j * TILE
        raw = alpha_row(parts, splat16(b), j)
        drawn = vand(vge(raw, splat16(_ALPHA_MIN)), vge(vload(last, last_at + at), splat16(number)))
        if not vany(drawn):
            continue
        alpha = vselect(drawn, vmin(raw, splat16(_ALPHA_MAX)), zero)
        inverse = one / (one - alpha)
        before = vload(work, PASSING + at) * inverse
        vstore(work, PASSING + at, before)
        weight = alpha * before
        total = total + weight
        largest = vmax(largest, weight)
        ratio = alpha * inverse
        for channel in range(3):
            plane = channel * PIXELS + at
            painted = weight * splat16(paint[row, channel])
            behind = vload(work, BEHIND + plane)
            shift = behind * ratio - painted
            change = vfma(shift, shift + two * vload(work, RESIDUAL + plane), change)
            vstore(work, BEHIND + plane, behind + painted)
    out[slot, 0], out[slot, 1] = vsum(change), vsum(total)
    vstore(lanes, 0, largest)
    top = lanes[0]
    for lane in range(1, 16):
        top = max(top, lanes[lane])
    out[slot, 2] = top


@kernel
def gather_contributions(raw, slot_starts, out):
    """out [V, 3] float64: sums (and the largest weight) over each visible splat's tiles."""
    for place in range(len(out)):
        change, total, largest = 0.0, 0.0, 0.0
        for slot in range(slot_starts[place], slot_starts[place + 1]):
            change += raw[slot, 0]
            total += raw[slot, 1]
            largest = max(largest, np.float64(raw[slot, 2]))
        out[place, 0], out[place, 1], out[place, 2] = change, total, largest
