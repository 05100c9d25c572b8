"""Which splats touch which 16x16 tile, in blending order. Exact: ellipses, not boxes."""

from __future__ import annotations

import math

import numpy as np

from stages.raster.api import ALPHA_MIN
from stages.raster.projection import GB, GK, GL, GVX, GVY, GX, GY
from stages.raster.simd import kernel, take_ticket

TILE = 16
CHUNKS = 16  # fixed, so that the lists do not depend on the number of threads
_LN2 = math.log(2.0)
_FAINTEST = math.log2(ALPHA_MIN)


@kernel
def radix_order(keys, order, keys2, order2):
    """Sort `order` by uint32 `keys` (both changed), stably, 11 bits a pass."""
    n = len(keys)
    counts = np.zeros(2048, np.int64)
    for bit in (0, 11, 22):
        counts[:] = 0
        for i in range(n):
            counts[(keys[i] >> np.uint32(bit)) & np.uint32(2047)] += 1
        total = 0
        for k in range(2048):
            here = counts[k]
            counts[k] = total
            total += here
        for i in range(n):
            digit = (keys[i] >> np.uint32(bit)) & np.uint32(2047)
            to = counts[digit]
            counts[digit] = to + 1
            keys2[to] = keys[i]
            order2[to] = order[i]
        keys[:], order[:] = keys2, order2


@kernel
def _comes_before(p, q, visible, means, quaternions, log_scales, opacity_logits, sh):
    """The documented order of equal depths: by the splats' own values, place against place."""
    i, j = visible[p], visible[q]
    for k in range(3):
        if means[i, k] != means[j, k]:
            return means[i, k] < means[j, k]
    if opacity_logits[i] != opacity_logits[j]:
        return opacity_logits[i] < opacity_logits[j]
    for k in range(3):
        if log_scales[i, k] != log_scales[j, k]:
            return log_scales[i, k] < log_scales[j, k]
    for k in range(4):
        if quaternions[i, k] != quaternions[j, k]:
            return quaternions[i, k] < quaternions[j, k]
    for band in range(sh.shape[1]):
        for channel in range(3):
            if sh[i, band, channel] != sh[j, band, channel]:
                return sh[i, band, channel] < sh[j, band, channel]
    return False


@kernel
def settle_ties(keys, order, visible, means, quaternions, log_scales, opacity_logits, sh):
    """Sort runs of equal keys by value (a heap sort: a flat wall can hold thousands of ties).

    order: places in `visible`, which holds the rows.
    """
    n = len(order)
    start = 0
    while start < n:
        end = start + 1
        while end < n and keys[end] == keys[start]:
            end += 1
        if end - start > 1:
            run = order[start:end]
            _heap_sort(run, visible, means, quaternions, log_scales, opacity_logits, sh)
        start = end


@kernel
def _heap_sort(run, visible, means, quaternions, log_scales, opacity_logits, sh):
    n = len(run)
    for step in range(n // 2 - 1 + n):
        # first build the heap from the last parent up, then move the largest to the end
        if step < n // 2:
            root, size = n // 2 - 1 - step, n
        else:
            size = n - 1 - (step - n // 2)
            run[0], run[size] = run[size], run[0]
            root = 0
        while True:
            child = 2 * root + 1
            if child >= size:
                break
            if child + 1 < size and _comes_before(
                run[child], run[child + 1], visible, means, quaternions, log_scales, opacity_logits, sh
            ):
                child += 1
            if not _comes_before(
                run[root], run[child], visible, means, quaternions, log_scales, opacity_logits, sh
            ):
                break
            run[root], run[child] = run[child], run[root]
            root = child


@kernel
def _span(low, high, half_along, half_across, slope, along_at, rest, reach2, across):
    """Range over one axis of the ellipse's part that lies in a slab of the other.

    low, high: the slab, relative to the centre. half_along, half_across: the ellipse's half
    extents on the axis asked for and on the slab's. slope: of its middle line over the slab's axis.
    along_at: where in the slab's axis the far end lies. rest: variance along, given the place
    across; across: variance of the slab's axis. (1, 0), an empty range, where they do not meet.
    """
    if low > half_across or high < -half_across:
        return 1.0, 0.0
    top, end = half_along, -half_along
    at = min(max(along_at, low), high)
    if at != along_at:
        top = slope * at + math.sqrt(max(rest * (reach2 - at * at / across), 0.0))
    at = min(max(-along_at, low), high)
    if at != -along_at:
        end = slope * at - math.sqrt(max(rest * (reach2 - at * at / across), 0.0))
    return end, top


@kernel
def _pixel_range(low, high, n):
    """Indices of the first and last pixel whose centre lies in [low, high], within 0..n-1."""
    first = math.ceil(min(max(low, 0.0), n + 1.0) - 0.5)
    last = math.floor(min(max(high, -1.0), n + 1.0) - 0.5)
    return max(np.int64(first), 0), min(np.int64(last), n - 1)


@kernel
def _reach2(level):
    """Squared reach, in sigmas, of a splat of log2 opacity `level`; a hair more, so that rounding
    never takes a pixel that the blending would draw."""
    return 2.0 * _LN2 * max(level - _FAINTEST, 0.0) * 1.00001 + 1e-5


@kernel
def bound_tiles(ticket, visible, geometry, width, height, bounds):
    """bounds[place]: tiles of a visible splat's bounding box, at least as many as it touches."""
    n = len(visible)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for place in range(chunk * size, min((chunk + 1) * size, n)):
            row = visible[place]
            reach2 = _reach2(geometry[row, GL])
            x, half_x = geometry[row, GX], math.sqrt(reach2 * geometry[row, GVX])
            y, half_y = geometry[row, GY], math.sqrt(reach2 * geometry[row, GVY])
            x0, x1 = _pixel_range(x - half_x, x + half_x, width)
            y0, y1 = _pixel_range(y - half_y, y + half_y, height)
            bounds[place] = 0
            if x1 >= x0 and y1 >= y0:
                bounds[place] = (x1 // TILE - x0 // TILE + 1) * (y1 // TILE - y0 // TILE + 1)


@kernel
def find_tiles(ticket, visible, geometry, width, height, found_starts, tiles, spans, counts):
    """The tiles that each visible splat touches, from found_starts[place] on, and how many.

    tiles: number of the tile. spans: first + 16 x last row of the splat within it.
    """
    tiles_x = (width + TILE - 1) // TILE
    n = len(visible)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for place in range(chunk * size, min((chunk + 1) * size, n)):
            row = visible[place]
            x, y = geometry[row, GX], geometry[row, GY]
            a, c = geometry[row, GVX], geometry[row, GVY]
            major = max(a, c)
            b, det = geometry[row, GK] * major, 0.5 * major / geometry[row, GB]
            reach2 = _reach2(geometry[row, GL])
            half_x, half_y = math.sqrt(reach2 * a), math.sqrt(reach2 * c)
            far_x, far_y = b * half_x / a, b * half_y / c
            slope_x, slope_y, rest_x, rest_y = b / c, b / a, det / c, det / a
            y0, y1 = _pixel_range(y - half_y, y + half_y, height)
            at = found_starts[place]
            for tile_y in range(y0 // TILE, y1 // TILE + 1 if y1 >= y0 else 0):
                low = max(tile_y * TILE, y0) + 0.5 - y
                high = min(tile_y * TILE + TILE - 1, y1) + 0.5 - y
                left, right = _span(low, high, half_x, half_y, slope_x, far_x, rest_x, reach2, c)
                x0, x1 = _pixel_range(x + left, x + right, width)
                if x1 < x0 or right < left:
                    continue
                for tile_x in range(x0 // TILE, x1 // TILE + 1):
                    west = tile_x * TILE + 0.5 - x
                    end, top = _span(
                        west, west + TILE - 1, half_y, half_x, slope_y, far_y, rest_y, reach2, a
                    )
                    r0, r1 = _pixel_range(y + end, y + top, height)
                    first = max(r0 - tile_y * TILE, 0)
                    last = min(r1 - tile_y * TILE, TILE - 1)
                    if last >= first:
                        tiles[at] = tile_y * tiles_x + tile_x
                        spans[at] = first + 16 * last
                        at += 1
            counts[place] = at - found_starts[place]


@kernel
def count_tiles(ticket, order, found_starts, counts, tiles, tile_counts):
    """tile_counts[chunk, tile]: entries, by chunk of the blending order."""
    n = len(order)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n)):
            start = found_starts[order[rank]]
            for at in range(start, start + counts[order[rank]]):
                tile_counts[chunk, tiles[at]] += 1


@kernel
def scan_counts(tile_counts, tile_starts):
    """Turn counts into positions: tile_counts becomes where each chunk writes in each tile's list.

    tile_starts [tiles + 1]. Returns the number of intersections.
    """
    total = 0
    for tile in range(tile_counts.shape[1]):
        tile_starts[tile] = total
        for chunk in range(CHUNKS):
            here = tile_counts[chunk, tile]
            tile_counts[chunk, tile] = total
            total += here
    tile_starts[tile_counts.shape[1]] = total
    return total


@kernel
def fill_tiles(
    ticket,
    order,
    visible,
    found_starts,
    slot_starts,
    tiles,
    found_spans,
    positions,
    members,
    slots,
    spans,
):
    """Write each tile's list, nearest first: the row, the slot where its gradient goes (splat by
    splat, in the order of rows), first and last pixel row."""
    n = len(order)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n)):
            place = order[rank]
            row, start = visible[place], found_starts[place]
            for slot in range(slot_starts[place], slot_starts[place + 1]):
                at = start + slot - slot_starts[place]
                position = positions[chunk, tiles[at]]
                positions[chunk, tiles[at]] = position + 1
                members[position] = row
                slots[position] = slot
                spans[position] = found_spans[at]
