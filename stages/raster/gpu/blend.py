"""Blending of a tile's splats from near to far, and its backward pass from far to near.

A tile is one program of one warp, without barriers. A splat's gradient is summed in registers and
written once for each tile that it touches, to a slot of its own, so that sums have a fixed order.
Both passes use `alpha_of`, because the backward pass divides by 1 - alpha.
"""

from __future__ import annotations

import triton
import triton.language as tl

from stages.raster import definition
from stages.raster.gpu.geometry import ALPHA_MAX, ALPHA_MIN
from stages.raster.gpu.inner import fused, inner, sum_of, top_of
from stages.raster.gpu.project import (
    COLOUR,
    CUT_HI,
    CUT_LO,
    DEPTH,
    LEVEL,
    MEAN_HI,
    MEAN_LO,
    ORIGIN,
    ORIGIN_CUT,
    RECORD,
    ROOT_A,
    ROOT_B,
    SLOPE_HI,
    SLOPE_LO,
    TALL,
)

TRANSMITTANCE_MIN = tl.constexpr(definition.TRANSMITTANCE_MIN)
NEVER = tl.constexpr(2**30)  # the last entry drawn in a pixel that was not finished
PATIENCE = tl.constexpr(16)  # entries between two checks whether a tile is finished
# Results of the backward pass for a splat: see `cpu.blend.SUMS`.
S_U, S_T, S_UU, S_TT, S_UT, S_1, S_RED = (tl.constexpr(k) for k in range(7))
SUMS = tl.constexpr(9)
SIZES = ("width", "height", "tiles_x")  # one compiled kernel for all


@inner
def pixels_of(tile, tiles_x, width, height, TILE: tl.constexpr):
    """(x, y of the tile's first pixel centre; offsets i, j of its pixels; where they lie in a plane
    of the picture; whether they are in it)."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    k = tl.arange(0, TILE * TILE)
    i, j = k % TILE, k // TILE
    inside = (left + i < width) & (top + j < height)
    at = (top + j) * width + left + i
    return left + 0.5, top + 0.5, i.to(tl.float32), j.to(tl.float32), at, inside


@inner
def tile_frame(record, x, y):
    """(u, t of the tile's first pixel; what a step along x and along y adds to each).

    Coordinates in the picture have 13 bits and the first part of K has 11: their product is exact.
    """
    tall = tl.load(record + TALL)
    high, low = tl.load(record + SLOPE_HI), tl.load(record + SLOPE_LO)
    major, minor = x + tall * (y - x), y + tall * (x - y)
    u = (major - tl.load(record + MEAN_HI)) - tl.load(record + MEAN_LO)
    t = (minor - tl.load(record + CUT_HI)) - high * major
    t = t - (low * major + tl.load(record + CUT_LO))
    slope = high + low
    return u, t, 1.0 - tall, tall, tall + (tall - 1.0) * slope, (1.0 - tall) - tall * slope


@inner
def alpha_of(record, frame, i, j):
    """Alpha of the tile's pixels, before the cap. A thread's pixels lie in one column, so what
    depends on the column is computed once for all of them."""
    u, t, u_x, u_y, t_x, t_y = frame
    a, b = tl.load(record + ROOT_A), tl.load(record + ROOT_B)
    along = tl.fma(a * u_y, j, tl.fma(a * u_x, i, a * u))
    across = tl.fma(b * t_y, j, tl.fma(b * t_x, i, b * t))
    level = tl.load(record + LEVEL)
    return tl.exp2(tl.fma(-across, across, tl.fma(-along, along, level)))


@inner
def inverse_of(x):
    """1 / x of 0.01 to 1, good to the last bit: errors add up over layers. A division that is
    rounded takes five times the instructions of this root and a step of Newton's method."""
    root = tl.rsqrt(x)
    y = root * root
    return fused(y, fused(-x, y, 1.0), y)


@triton.jit(do_not_specialize=SIZES)
def blend_kernel(
    records,
    members,
    starts,
    image,
    transmittance,
    last,
    red,
    green,
    blue,
    width,
    height,
    tiles_x,
    DEPTHS: tl.constexpr,
    TILE: tl.constexpr,
):
    """Draw a tile. image [4 or 6, H, W]: colour, alpha, and if DEPTHS expected and median depth.

    light [H, W]: the transmittance that is left. last [H, W]: the number of the last entry drawn,
    or NEVER. members: rows of the splats, tile by tile, from starts[tile]. red, green, blue:
    background.
    """
    x, y, i, j, at, inside = pixels_of(tl.program_id(0), tiles_x, width, height, TILE)
    passing = tl.where(inside, 1.0, 0.0)
    finished_at = tl.full([TILE * TILE], NEVER, tl.int32)
    r, g, b, depth, median = passing * 0.0, passing * 0.0, passing * 0.0, passing * 0.0, passing * 0
    start = tl.load(starts + tl.program_id(0))
    count = (tl.load(starts + tl.program_id(0) + 1) - start).to(tl.int32)
    done = count * 0
    while done < count:
        end = tl.minimum(done + PATIENCE, count)
        for number in range(done, end):
            record = records + tl.load(members + start + number).to(tl.int64) * RECORD
            alpha = alpha_of(record, tile_frame(record, x, y), i, j)
            drawn = (alpha >= ALPHA_MIN) & (passing >= TRANSMITTANCE_MIN)
            alpha = tl.where(drawn, tl.minimum(alpha, ALPHA_MAX), 0.0)
            weight = alpha * passing
            left = passing * (1.0 - alpha)
            r = tl.fma(weight, tl.load(record + COLOUR), r)
            g = tl.fma(weight, tl.load(record + COLOUR + 1), g)
            b = tl.fma(weight, tl.load(record + COLOUR + 2), b)
            if DEPTHS:
                z = tl.load(record + DEPTH)
                depth = tl.fma(weight, z, depth)
                median = tl.where((passing >= 0.5) & (left < 0.5), z, median)
            finished_at = tl.where(drawn & (left < TRANSMITTANCE_MIN), number + 1, finished_at)
            passing = left
        done = tl.where(top_of(passing, 0) >= TRANSMITTANCE_MIN, end, count)
    plane = width * height
    tl.store(image + at, tl.fma(passing, red, r), mask=inside)
    tl.store(image + plane + at, tl.fma(passing, green, g), mask=inside)
    tl.store(image + 2 * plane + at, tl.fma(passing, blue, b), mask=inside)
    tl.store(image + 3 * plane + at, 1.0 - passing, mask=inside)
    if DEPTHS:
        mean = depth / tl.maximum(1.0 - passing, ALPHA_MIN / 2)
        tl.store(image + 4 * plane + at, mean, mask=inside)
        tl.store(image + 5 * plane + at, median, mask=inside)
    tl.store(transmittance + at, passing, mask=inside)
    tl.store(last + at, finished_at, mask=inside)


@inner
def furthest(starts, last, at, inside):
    """(first entry of the tile, how many of its entries reach any pixel, last [pixels])."""
    start = tl.load(starts + tl.program_id(0))
    count = (tl.load(starts + tl.program_id(0) + 1) - start).to(tl.int32)
    finished_at = tl.load(last + at, mask=inside, other=0)
    return start, tl.minimum(count, top_of(finished_at, 0)), finished_at


@inner
def origin_frame(record, x, y):
    """(u, t) of the tile's first pixel from the origin of the sums."""
    tall = tl.load(record + TALL)
    major, minor = x + tall * (y - x), y + tall * (x - y)
    t = (minor - tl.load(record + ORIGIN_CUT)) - tl.load(record + SLOPE_HI) * major
    return major - tl.load(record + ORIGIN), t - tl.load(record + SLOPE_LO) * major


@triton.jit(do_not_specialize=SIZES)
def blend_gradient_kernel(
    records,
    members,
    slots,
    starts,
    transmittance,
    last,
    v_image,
    gradients,
    red,
    green,
    blue,
    width,
    height,
    tiles_x,
    TILE: tl.constexpr,
):
    """gradients [entries, SUMS] at each entry's slot, from v_image [3, H, W]; zero before."""
    x, y, i, j, at, inside = pixels_of(tl.program_id(0), tiles_x, width, height, TILE)
    start, count, finished_at = furthest(starts, last, at, inside)
    plane = width * height
    v_r = tl.load(v_image + at, mask=inside, other=0.0)
    v_g = tl.load(v_image + plane + at, mask=inside, other=0.0)
    v_b = tl.load(v_image + 2 * plane + at, mask=inside, other=0.0)
    passing = tl.load(transmittance + at, mask=inside, other=0.0)
    behind = tl.fma(v_r, red, tl.fma(v_g, green, v_b * blue)) * passing
    for back in range(count):
        number = count - back
        entry = start + number - 1
        record = records + tl.load(members + entry).to(tl.int64) * RECORD
        frame = tile_frame(record, x, y)
        raw = alpha_of(record, frame, i, j)
        drawn = (raw >= ALPHA_MIN) & (finished_at >= number)
        alpha = tl.where(drawn, tl.minimum(raw, ALPHA_MAX), 0.0)
        inverse = inverse_of(1.0 - alpha)
        passing = passing * inverse
        weight = alpha * passing
        out = gradients + tl.load(slots + entry) * SUMS
        tl.store(out + S_RED, sum_of(weight * v_r, 0))
        tl.store(out + S_RED + 1, sum_of(weight * v_g, 0))
        tl.store(out + S_RED + 2, sum_of(weight * v_b, 0))
        shade = v_r * tl.load(record + COLOUR)
        shade = tl.fma(v_g, tl.load(record + COLOUR + 1), shade)
        shade = tl.fma(v_b, tl.load(record + COLOUR + 2), shade)
        v = alpha * (behind * inverse - passing * shade)
        behind = tl.fma(weight, shade, behind)
        v = tl.where(raw < ALPHA_MAX, v, 0.0)  # no gradient where alpha is capped
        _, _, u_x, u_y, t_x, t_y = frame
        u, t = origin_frame(record, x, y)
        u = tl.fma(j, u_y, tl.fma(i, u_x, u))
        t = tl.fma(j, t_y, tl.fma(i, t_x, t))
        v_u, v_t = v * u, v * t
        tl.store(out + S_U, sum_of(v_u, 0))
        tl.store(out + S_T, sum_of(v_t, 0))
        tl.store(out + S_UU, sum_of(v_u * u, 0))
        tl.store(out + S_TT, sum_of(v_t * t, 0))
        tl.store(out + S_UT, sum_of(v_u * t, 0))
        tl.store(out + S_1, sum_of(v, 0))


@triton.jit(do_not_specialize=SIZES)
def contribution_kernel(
    records,
    members,
    slots,
    starts,
    transmittance,
    last,
    residual,
    out,
    red,
    green,
    blue,
    width,
    height,
    tiles_x,
    TILE: tl.constexpr,
):
    """out [entries, 8] at each entry's slot: columns as in `definition.CONTRIBUTIONS`. residual
    [3, H, W]: see `cpu.contributions`."""
    x, y, i, j, at, inside = pixels_of(tl.program_id(0), tiles_x, width, height, TILE)
    start, count, finished_at = furthest(starts, last, at, inside)
    plane = width * height
    e_r = tl.load(residual + at, mask=inside, other=0.0)
    e_g = tl.load(residual + plane + at, mask=inside, other=0.0)
    e_b = tl.load(residual + 2 * plane + at, mask=inside, other=0.0)
    passing = tl.load(transmittance + at, mask=inside, other=0.0)
    behind_r, behind_g, behind_b = passing * red, passing * green, passing * blue
    for back in range(count):
        number = count - back
        entry = start + number - 1
        record = records + tl.load(members + entry).to(tl.int64) * RECORD
        raw = alpha_of(record, tile_frame(record, x, y), i, j)
        drawn = (raw >= ALPHA_MIN) & (finished_at >= number)
        alpha = tl.where(drawn, tl.minimum(raw, ALPHA_MAX), 0.0)
        inverse = inverse_of(1.0 - alpha)
        passing = passing * inverse
        weight, ratio = alpha * passing, alpha * inverse
        painted = weight * tl.load(record + COLOUR)
        shift = behind_r * ratio - painted
        change, square = shift * (shift + 2.0 * e_r), shift * shift
        behind_r += painted
        painted = weight * tl.load(record + COLOUR + 1)
        shift = behind_g * ratio - painted
        change += shift * (shift + 2.0 * e_g)
        square += shift * shift
        behind_g += painted
        painted = weight * tl.load(record + COLOUR + 2)
        shift = behind_b * ratio - painted
        change += shift * (shift + 2.0 * e_b)
        square += shift * shift
        behind_b += painted
        to = out + tl.load(slots + entry) * 8
        tl.store(to, sum_of(change, 0))
        tl.store(to + 1, sum_of(square, 0))
        tl.store(to + 2, sum_of(weight, 0))
        tl.store(to + 3, top_of(weight, 0))
        tl.store(to + 4, sum_of(weight * weight, 0))
        tl.store(to + 5, sum_of(weight * e_r, 0))
        tl.store(to + 6, sum_of(weight * e_g, 0))
        tl.store(to + 7, sum_of(weight * e_b, 0))
