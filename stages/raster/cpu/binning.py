"""Lists of the splats that touch each 16x16 tile, in blending order.

Ellipses are tested exactly to blocks of 4x4 pixels. The tiles of each splat are found in the order
of rows, then written tile by tile, nearest splat first.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster.cpu.projection import (
    GB,
    GK,
    GL,
    GVX,
    GVY,
    GX,
    GY,
)
from stages.raster.definition import ALPHA_MIN, Arrays
from stages.raster.kernels.simd import kernel, prefetch, take_ticket
from stages.raster.kernels.simd32 import least8, most8, span_bits
from stages.raster.kernels.simd64 import (
    dceil,
    dfloor,
    dgt,
    dload,
    dmax,
    dmin,
    dselect,
    dsqrt,
    dstore,
)

TILE = 16  # pixels across and down
BLOCK = 4  # a tile is 4x4 blocks of 4x4 pixels
_ALL_BLOCKS = 0xFFFF  # mask of a tile's blocks
CHUNKS = 16  # fixed, so that the lists do not depend on the number of threads
# Columns of `places`, one row for each visible splat: its row in the input, the position and number
# of its tiles, and the slot of its first gradient.
ROW, FOUND, COUNT, SLOT = range(4)
_LN2 = math.log(2.0)
_HALF_LOG2E = 0.5 / _LN2
_FAINTEST = math.log2(ALPHA_MIN)
_FAR = 1e9
BATCH = 32  # splats whose spans are computed together
_EIGHT = np.arange(8.0)


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
        for i in range(n):  # slices would add much code that checks their lengths
            keys[i], order[i] = keys2[i], order2[i]


def sort_by_depth(
    visible: NDArray[np.int32],
    paint: NDArray[np.float32],
    arrays: Arrays,
    keys: NDArray[np.float32],
    order: NDArray[np.int32],
    keys2: NDArray[np.uint32],
    order2: NDArray[np.int32],
) -> None:
    """order [V]: indices into `visible`, nearest first; see `_order_ties` for equal depths."""
    keys[:], order[:] = paint[visible, 3], np.arange(len(visible))
    # depths are positive, so their bits sort as they do
    radix_order(keys.view(np.uint32), order, keys2, order2)
    _order_ties(order, keys, visible, arrays)


def _order_ties(
    order: NDArray[np.int32],
    depths: NDArray[np.float32],
    visible: NDArray[np.int32],
    arrays: Arrays,
) -> None:
    """Put runs of equal `depths` [V], which are sorted, into the order that `reference` defines:
    by the splats' own values. Few splats are left to compare after their means."""
    means, quaternions, log_scales, opacity_logits, sh = arrays
    tied = np.flatnonzero(_in_runs(depths[1:] == depths[:-1]))
    run: NDArray[Any] = depths[tied]
    by_coefficient = sh.reshape(len(sh), 3 * sh.shape[1])
    for values in (means, opacity_logits[:, None], log_scales, quaternions, by_coefficient):
        if not len(tied):
            return
        own = values[visible[order[tied]]]
        sorting = np.lexsort((*own.T[::-1], run))
        order[tied] = order[tied][sorting]
        own, run = own[sorting], run[sorting]
        same = (run[1:] == run[:-1]) & (own[1:] == own[:-1]).all(axis=1)
        run = np.cumsum(np.append(0, ~same))
        left = _in_runs(same)
        tied, run = tied[left], run[left]


def _in_runs(same: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[n + 1] whether an element equals the one before or after it. same [n]: whether an element
    equals the next."""
    return np.asarray(np.append(same, False) | np.append(False, same))


@kernel
def _pixel_range(low, high, n):
    """Indices of the first and last pixel whose centre lies in [low, high], within 0..n-1."""
    first = math.ceil(min(max(low, 0.0), n + 1.0) - 0.5)
    last = math.floor(min(max(high, -1.0), n + 1.0) - 0.5)
    return max(np.int64(first), 0), min(np.int64(last), n - 1)


@kernel
def _reach2(level):
    """Squared radius, in sigmas, at which a splat of log2 opacity `level` reaches ALPHA_MIN. It is
    slightly enlarged, so that rounding never loses a pixel that blending would draw."""
    return 2.0 * _LN2 * max(level - _FAINTEST, 0.0) * 1.00001 + 1e-5


@kernel
def bound_tiles(ticket, visible, geometry, width, height, bounds):
    """bounds[place]: number of tiles of a visible splat's bounding box, plus one: the most that
    `find_tiles` writes."""
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
            bounds[place] = 1
            if x1 >= x0 and y1 >= y0:
                bounds[place] += (x1 // TILE - x0 // TILE + 1) * (y1 // TILE - y0 // TILE + 1)


@kernel
def _block_spans(geometry, row, width, y0, y1, reach2, top, spans, at):
    """First (spans[at : at + 8]) and last (the next 8) of the 4-pixel columns that a splat touches
    in each of the eight block rows from pixel row `top` on; _FAR and -1 where it touches none.

    y0, y1: the pixel rows that it touches. Within a slab of rows the ellipse extends furthest right
    at the row y nearest to its rightmost point, to slope y + sqrt((reach^2 - y^2 / c) det / c).
    """
    x, y = geometry[row, GX], geometry[row, GY]
    a, c = geometry[row, GVX], geometry[row, GVY]
    major = max(a, c)
    b, thin = geometry[row, GK] * major, geometry[row, GB]
    per_c = 1.0 / c
    # det / c, det from B^2 = log2(e) / 2 x major / det
    slope, rest = b * per_c, _HALF_LOG2E * major / (thin * thin) * per_c
    right_end = b * math.sqrt(reach2 / a)
    first_row = BLOCK * dload(_EIGHT, 0) + top
    low, high = dmax(first_row, y0), dmin(first_row + (BLOCK - 1), y1)
    empty = dgt(low, high)
    low, high = low + (0.5 - y), high + (0.5 - y)
    y_at = dmin(dmax(low, right_end), high)
    right = slope * y_at + dsqrt(dmax(rest * (reach2 - y_at * y_at * per_c), 0.0))
    y_at = dmin(dmax(low, -right_end), high)
    left = slope * y_at - dsqrt(dmax(rest * (reach2 - y_at * y_at * per_c), 0.0))
    # first and last pixel whose centre is inside, then their blocks
    first = dmax(dceil(dmin(left + (x - 0.5), width + 1.0)), 0.0)
    last = dmin(dfloor(dmax(right + (x - 0.5), -2.0)), width - 1.0)
    first_block, last_block = dfloor(first * (1.0 / BLOCK)), dfloor(last * (1.0 / BLOCK))
    nothing = dgt(first, last)
    dstore(spans, at, dselect(empty, _FAR, dselect(nothing, _FAR, first_block)))
    dstore(spans, at + 8, dselect(empty, -1.0, dselect(nothing, -1.0, last_block)))


@kernel
def _emit_tile_rows(spans, q0, first_tile, tiles_x, at, columns, tiles, masks):
    """Write the tiles of two tile rows from position `at` on; returns the position after them.

    Their block rows are the eight from spans[q0] on. first_tile: number of the upper row's first
    tile. columns: scratch, [tiles_x + 2]. Two tiles of a row are written without a branch; the
    position does not advance if they are not touched.
    """
    first = least8(spans, q0) // 4
    count = max(most8(spans, q0 + 8) // 4 - first + 1, 2)
    for k in range(count):
        columns[k] = span_bits(spans, q0, 4 * (first + k))
    for row in range(2):
        tile, shift = first_tile + row * tiles_x + first, 16 * row
        for k in (0, 1):
            mask = (columns[k] >> shift) & _ALL_BLOCKS
            tiles[at], masks[at] = tile + k, mask
            at += mask != 0
        for k in range(2, count):
            mask = (columns[k] >> shift) & _ALL_BLOCKS
            tiles[at], masks[at] = tile + k, mask
            at += mask != 0
    return at


@kernel
def _span_batch(first, last, visible, geometry, width, height, places, groups, spans):
    """Block spans of visible splats first..last, in groups of two tile rows; returns the number of
    groups.

    groups [G, 2]: index of the splat, and the upper tile row. spans [16 G]: see `_block_spans`.
    """
    n = 0
    for place in range(first, last):
        row = visible[place]
        reach2 = _reach2(geometry[row, GL])
        y, half_y = geometry[row, GY], math.sqrt(reach2 * geometry[row, GVY])
        y0, y1 = _pixel_range(y - half_y, y + half_y, height)
        for tile_y in range(y0 // TILE, y1 // TILE + 1 if y1 >= y0 else 0, 2):
            top = tile_y * TILE
            _block_spans(geometry, row, width, y0, y1, reach2, top, spans, 16 * n)
            groups[n, 0], groups[n, 1] = place, tile_y
            n += 1
        places[place, ROW], places[place, COUNT] = row, 0
    return n


@kernel
def find_tiles(ticket, visible, geometry, width, height, places, tiles, masks):
    """Write the tiles that each visible splat touches from places[place, FOUND] on, ROW and COUNT.

    tiles: number of the tile. masks: its touched 4x4-pixel blocks, bit 4 row + column.

    Spans are computed for a batch of splats before their tiles are written: the number of tiles is
    unpredictable, and a mispredicted branch costs least when its operands are ready.
    """
    tiles_x = (width + TILE - 1) // TILE
    most = BATCH * ((height + TILE - 1) // TILE // 2 + 1)
    groups, spans = np.empty((most, 2), np.int64), np.empty(16 * most, np.int32)
    columns = np.empty(tiles_x + 2, np.int64)
    n = len(visible)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        end = min((chunk + 1) * size, n)
        for first in range(chunk * size, end, BATCH):
            last = min(first + BATCH, end)
            found = _span_batch(
                first, last, visible, geometry, width, height, places, groups, spans
            )
            for group in range(found):
                place, tile_y = groups[group, 0], groups[group, 1]
                start = np.int64(places[place, FOUND])
                at = start + places[place, COUNT]
                upper = tile_y * tiles_x
                at = _emit_tile_rows(spans, 16 * group, upper, tiles_x, at, columns, tiles, masks)
                places[place, COUNT] = at - start


@kernel
def _look_ahead(rank, last, order, places, tiles):
    """Prefetch what later ranks read; it is not contiguous."""
    prefetch(places, 4 * np.int64(order[min(rank + 16, last)]))
    prefetch(tiles, np.int64(places[order[min(rank + 8, last)], FOUND]))


@kernel
def count_tiles(ticket, order, places, tiles, tile_counts):
    """tile_counts[chunk, tile]: number of entries, by chunk of the blending order."""
    n = len(order)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n)):
            _look_ahead(rank, n - 1, order, places, tiles)
            start = places[order[rank], FOUND]
            for at in range(start, start + places[order[rank], COUNT]):
                tile_counts[chunk, tiles[at]] += 1


@kernel
def scan_counts(tile_counts, tile_starts):
    """Turn counts into positions: where each chunk writes in each tile's list.

    tile_starts [tiles + 1] is filled, too. Returns the number of intersections.
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
def fill_tiles(ticket, order, places, tiles, found_masks, positions, members, slots, masks):
    """Write each tile's list, nearest first: the splat's row, the slot of its gradient (slots are
    ordered by row), and the mask of its blocks."""
    n = len(order)
    size = (n + CHUNKS - 1) // CHUNKS
    while True:
        chunk = take_ticket(ticket)
        if chunk >= CHUNKS:
            break
        for rank in range(chunk * size, min((chunk + 1) * size, n)):
            _look_ahead(rank, n - 1, order, places, tiles)
            place = order[rank]
            start, slot = places[place, FOUND], places[place, SLOT]
            prefetch(found_masks, np.int64(places[order[min(rank + 8, n - 1)], FOUND]))
            for k in range(places[place, COUNT]):
                tile = tiles[start + k]
                position = positions[chunk, tile]
                positions[chunk, tile] = position + 1
                members[position] = places[place, ROW]
                slots[position] = slot + k
                masks[position] = found_masks[start + k]
