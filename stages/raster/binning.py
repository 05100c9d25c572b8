"""Which splats touch which 16x16 tile, in blending order. Exact: ellipses, not boxes."""

from __future__ import annotations

import math

import numpy as np

from stages.raster.api import ALPHA_MIN
from stages.raster.projection import GB, GK, GO, GVX, GVY, GX, GY
from stages.raster.simd import kernel, take_ticket

TILE = 16
CHUNKS = 16  # fixed, so that the lists do not depend on the number of threads


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
def _comes_before(i, j, means, quaternions, log_scales, opacity_logits, sh):
    """The documented order of equal depths: by the splats' own values, row against row."""
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
def settle_ties(keys, order, means, quaternions, log_scales, opacity_logits, sh):
    """Sort runs of equal keys by value (a heap sort: a flat wall can hold thousands of ties)."""
    n = len(order)
    start = 0
    while start < n:
        end = start + 1
        while end < n and keys[end] == keys[start]:
            end += 1
        if end - start > 1:
            run = order[start:end]
            _heap_sort(run, means, quaternions, log_scales, opacity_logits, sh)
        start = end


@kernel
def _heap_sort(run, means, quaternions, log_scales, opacity_logits, sh):
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
                run[child], run[child + 1], means, quaternions, log_scales, opacity_logits, sh
            ):
                child += 1
            if not _comes_before(
                run[root], run[child], means, quaternions, log_scales, opacity_logits, sh
            ):
                break
            run[root], run[child] = run[child], run[root]
            root = child


@kernel
def _span(low, high, along, across, cov, det, reach2):
    """Range over one axis of the ellipse's part that lies in a slab of the other.

    low, high: the slab, relative to the centre. along: variance of the axis asked for; across: of
    the slab's axis. Returns (1, 0), an empty range, where they do not meet.
    """
    half_across = math.sqrt(reach2 * across)
    if low > half_across or high < -half_across:
        return 1.0, 0.0
    half = math.sqrt(reach2 * along)
    touch = cov * half / along  # where, in the slab's axis, the far end lies
    at = min(max(touch, low), high)
    at2 = min(max(-touch, low), high)
    slope, rest = cov / across, det / across
    top = (
        half if at == touch else slope * at + math.sqrt(max(rest * (reach2 - at * at / across), 0))
    )
    end = (
        -half
        if at2 == -touch
        else slope * at2 - math.sqrt(max(rest * (reach2 - at2 * at2 / across), 0))
    )
    return end, top


@kernel
def _ellipse(geometry, rank):
    """(cov_xx, cov_xy, cov_yy, det, squared reach in sigmas) of a geometry record."""
    major = max(geometry[rank, GVX], geometry[rank, GVY])
    det = 0.5 * major / geometry[rank, GB]
    # a hair more, so that rounding never takes a pixel that the blending would draw
    reach2 = 2.0 * math.log(max(geometry[rank, GO] / ALPHA_MIN, 1.0)) * 1.00001 + 1e-5
    return geometry[rank, GVX], geometry[rank, GK] * major, geometry[rank, GVY], det, reach2


@kernel
def _pixel_range(low, high, n):
    """Indices of the first and last pixel whose centre lies in [low, high], within 0..n-1."""
    first = math.ceil(min(max(low, 0.0), n + 1.0) - 0.5)
    last = math.floor(min(max(high, -1.0), n + 1.0) - 0.5)
    return max(np.int64(first), 0), min(np.int64(last), n - 1)


@kernel
def count_tiles(ticket, geometry, n_visible, width, height, tile_counts, splat_tiles):
    """tile_counts[chunk, tile] and splat_tiles[rank]: intersections, by chunk of ranks."""
    tiles_x = (width + TILE - 1) // TILE
    size = (n_visible + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n_visible)):
            a, b, c, det, reach2 = _ellipse(geometry, rank)
            y_reach = math.sqrt(reach2 * c)
            y0, y1 = _pixel_range(
                geometry[rank, GY] - y_reach, geometry[rank, GY] + y_reach, height
            )
            found = 0
            for tile_y in range(y0 // TILE, y1 // TILE + 1 if y1 >= y0 else 0):
                low = max(tile_y * TILE, y0) + 0.5 - geometry[rank, GY]
                high = min(tile_y * TILE + TILE - 1, y1) + 0.5 - geometry[rank, GY]
                left, right = _span(low, high, a, c, b, det, reach2)
                x0, x1 = _pixel_range(geometry[rank, GX] + left, geometry[rank, GX] + right, width)
                if x1 >= x0 and right >= left:
                    for tile_x in range(x0 // TILE, x1 // TILE + 1):
                        tile_counts[chunk, tile_y * tiles_x + tile_x] += 1
                        found += 1
            splat_tiles[rank] = found


@kernel
def scan_counts(tile_counts, tile_starts, splat_tiles, slot_starts):
    """Turn counts into positions: tile_counts becomes where each chunk writes in each tile's list.

    tile_starts[tiles + 1], slot_starts[visible + 1]. Returns the number of intersections.
    """
    total = 0
    for tile in range(tile_counts.shape[1]):
        tile_starts[tile] = total
        for chunk in range(CHUNKS):
            here = tile_counts[chunk, tile]
            tile_counts[chunk, tile] = total
            total += here
    tile_starts[tile_counts.shape[1]] = total
    slot = 0
    for rank in range(len(splat_tiles)):
        slot_starts[rank] = slot
        slot += splat_tiles[rank]
    slot_starts[len(splat_tiles)] = slot
    return total


@kernel
def fill_tiles(
    ticket, geometry, n_visible, width, height, positions, slot_starts, ranks, slots, rows
):
    """Write each tile's list: rank, slot (where the gradient goes) and first and last row.

    rows: first + 16 x last, within the tile.
    """
    tiles_x = (width + TILE - 1) // TILE
    size = (n_visible + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n_visible)):
            a, b, c, det, reach2 = _ellipse(geometry, rank)
            y_reach = math.sqrt(reach2 * c)
            y0, y1 = _pixel_range(
                geometry[rank, GY] - y_reach, geometry[rank, GY] + y_reach, height
            )
            slot = slot_starts[rank]
            for tile_y in range(y0 // TILE, y1 // TILE + 1 if y1 >= y0 else 0):
                low = max(tile_y * TILE, y0) + 0.5 - geometry[rank, GY]
                high = min(tile_y * TILE + TILE - 1, y1) + 0.5 - geometry[rank, GY]
                left, right = _span(low, high, a, c, b, det, reach2)
                x0, x1 = _pixel_range(geometry[rank, GX] + left, geometry[rank, GX] + right, width)
                if x1 < x0 or right < left:
                    continue
                for tile_x in range(x0 // TILE, x1 // TILE + 1):
                    west = tile_x * TILE + 0.5 - geometry[rank, GX]
                    end, top = _span(west, west + TILE - 1, c, a, b, det, reach2)
                    r0, r1 = _pixel_range(
                        geometry[rank, GY] + end, geometry[rank, GY] + top, height
                    )
                    first = max(r0 - tile_y * TILE, 0)
                    last = min(r1 - tile_y * TILE, TILE - 1)
                    tile = tile_y * tiles_x + tile_x
                    position = positions[chunk, tile]
                    positions[chunk, tile] = position + 1
                    ranks[position] = rank
                    slots[position] = slot
                    # an empty range (rounding at the rim) is kept as "first > last": no rows
                    rows[position] = first + 16 * last if last >= first else 1
                    slot += 1
