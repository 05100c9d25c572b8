"""Projection of splats: one 64-byte record for each, which blending reads, and its ellipse.

The record holds the exponent around the axis of the larger variance, to base 2, as the CPU does:
    log2 alpha = level - (A u)^2 - (B t)^2,  u = major - mean,  t = minor - K major - cut,
major and minor a pixel's coordinates along that axis's direction and the other. Mean and cut are
kept as a whole number and the rest, K as 11 bits and the rest: what a tile takes from them is then
exact, so that float32 does for needles of any length (`blend.tile_frame`).
"""

from __future__ import annotations

import triton
import triton.language as tl

from stages.raster.gpu.geometry import (
    ALPHA_MIN,
    CX,
    CY,
    DILATION,
    FX,
    FY,
    LOG2E,
    NEAR,
    OPACITY,
    SH,
    axis_x,
    axis_y,
    axis_z,
    basis,
    column,
    cross,
    direction,
    drawable,
    number,
    position,
    scale,
    slopes,
    unit_quaternion,
)
from stages.raster.gpu.geometry import COLOUR_MAX as COLOUR_MAX
from stages.raster.gpu.inner import inner

RECORD = tl.constexpr(16)
MEAN_HI, MEAN_LO, CUT_HI, CUT_LO, SLOPE_HI, SLOPE_LO, ROOT_A, ROOT_B, LEVEL, TALL = (
    tl.constexpr(k) for k in range(10)
)
COLOUR, DEPTH = tl.constexpr(10), tl.constexpr(13)
# Origin of the sums of the backward pass: see `cpu.projection.sums_origin`.
ORIGIN, ORIGIN_CUT = tl.constexpr(14), tl.constexpr(15)
# The ellipse outside which alpha is below 1/255: centre, half the size of its box, correlation and
# sqrt(1 - correlation^2); first and last row of tiles.
SHAPE = tl.constexpr(8)
S_X, S_Y, S_HALF_X, S_HALF_Y, S_RHO, S_THIN, S_FIRST, S_LAST = (tl.constexpr(k) for k in range(8))
OUT_OF_VIEW, VISIBLE, CULLED = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
FAR = tl.constexpr(1e37)
SQRT_LOG2E = tl.constexpr(1.2011224087864498)
LOG_FAINTEST = tl.constexpr(-5.541263545158426)  # ln(1 / 255)


@inner
def put(row, k, mask, value):
    tl.store(row + k, value.to(tl.float32), mask=mask)


@inner
def footprint_rows(cam, rows, at, mask, width, SMOOTH: tl.constexpr, REAL: tl.constexpr):
    """(V0, V1: the rows of V = J W R diag(s); the smoothing's factor of the opacity; x, y, z)."""
    x, y, z = position(cam, rows, at, mask, REAL)
    u, v, _, _ = slopes(cam, x, y, z, REAL)
    fx, fy = number(cam, FX, REAL), number(cam, FY, REAL)
    j00, j02, j11, j12 = fx / z, -fx * u / z, fy / z, -fy * v / z
    q0, q1, q2, q3, _ = unit_quaternion(rows, at, mask, REAL)
    s, k0 = scale(rows, at, mask, width, 0, SMOOTH, REAL)
    a, b, c = axis_x(cam, q0, q1, q2, q3, REAL)
    x0, y0 = (j00 * a + j02 * c) * s, (j11 * b + j12 * c) * s
    s, k1 = scale(rows, at, mask, width, 1, SMOOTH, REAL)
    a, b, c = axis_y(cam, q0, q1, q2, q3, REAL)
    x1, y1 = (j00 * a + j02 * c) * s, (j11 * b + j12 * c) * s
    s, k2 = scale(rows, at, mask, width, 2, SMOOTH, REAL)
    a, b, c = axis_z(cam, q0, q1, q2, q3, REAL)
    x2, y2 = (j00 * a + j02 * c) * s, (j11 * b + j12 * c) * s
    return x0, x1, x2, y0, y1, y2, k0 * k1 * k2, x, y, z


@inner
def covariance(cam, x0, x1, x2, y0, y1, y2, ANTIALIAS: tl.constexpr, REAL: tl.constexpr):
    """(a, b, c, determinant by Cauchy-Binet, minors, compensation) of V V^T + e I."""
    m0, m1, m2 = cross(x0, x1, x2, y0, y1, y2)
    minors = m0 * m0 + m1 * m1 + m2 * m2
    a, b = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2
    c = y0 * y0 + y1 * y1 + y2 * y2
    e = number(cam, DILATION, REAL)
    det = minors + e * (a + c) + e * e
    kept = det * 0.0 + 1.0
    if ANTIALIAS:
        kept = tl.sqrt(tl.where(minors > 1e-60, minors, 1e-60) / det)
    return a + e, b, c + e, det, minors, kept


@inner
def opacity_of(rows, at, mask, REAL: tl.constexpr):
    return 1.0 / (1.0 + tl.exp(-column(rows, at, mask, OPACITY, REAL)))


@inner
def whole_part(x):
    return tl.floor(x + 0.5).to(tl.float32)


@inner
def sums_origin(x, y, k, tall, across, down):
    """(o, cut or NaN for the axis's own): whole pixels, near a mean in the picture; else where the
    offsets are least in the picture. across, down: its size along the major axis and the other."""
    major, minor = tl.where(tall, y, x), tl.where(tall, x, y)
    inside = (major >= 0.0) & (major <= across) & (minor >= 0.0) & (minor <= down)
    far = tl.where(k > 0.0, across, across * 0.0)
    near = across - far
    o = tl.minimum(tl.maximum(tl.floor(major + 0.5), 0.0), across)
    below = -minor - k * (far - major) > 0.0
    above = down - minor - k * (near - major) < 0.0
    own = x * float("nan")
    cut = tl.where(below, -k * far, tl.where(above, down - k * near, own))
    return o, tl.where(inside, own, cut)


@inner
def put_record(record, mask, x, y, a, b, c, det, opacity, depth, width, height):
    tall = c > a
    major_variance = tl.maximum(a, c)
    k = b / major_variance
    major, minor = tl.where(tall, y, x), tl.where(tall, x, y)
    cut = minor - k * major
    mean_hi, cut_hi = whole_part(major), whole_part(cut)
    slope_hi = tl.floor(k * 2048.0 + 0.5) / 2048.0
    put(record, MEAN_HI, mask, mean_hi)
    put(record, MEAN_LO, mask, major - mean_hi.to(x.dtype))
    put(record, CUT_HI, mask, cut_hi)
    put(record, CUT_LO, mask, cut - cut_hi.to(x.dtype))
    put(record, SLOPE_HI, mask, slope_hi)
    put(record, SLOPE_LO, mask, k - slope_hi)
    put(record, ROOT_A, mask, tl.sqrt(0.5 / major_variance) * SQRT_LOG2E)
    put(record, ROOT_B, mask, tl.sqrt(0.5 * major_variance / det) * SQRT_LOG2E)
    put(record, LEVEL, mask, tl.log(opacity) * LOG2E)
    put(record, TALL, mask, tl.where(tall, 1.0, 0.0))
    put(record, DEPTH, mask, depth)
    across, down = tl.where(tall, height, width), tl.where(tall, width, height)
    o, origin_cut = sums_origin(x, y, k, tall, across.to(x.dtype), down.to(x.dtype))
    origin_cut = origin_cut.to(tl.float32)
    put(record, ORIGIN, mask, o)
    put(record, ORIGIN_CUT, mask, tl.where(origin_cut == origin_cut, origin_cut, cut_hi))


@inner
def put_shape(shape, mask, x, y, half_x, half_y, rho, thin, height, tile):
    x, y = x.to(tl.float32), y.to(tl.float32)
    half_x, half_y = half_x.to(tl.float32), half_y.to(tl.float32)
    put(shape, S_X, mask, x)
    put(shape, S_Y, mask, y)
    put(shape, S_HALF_X, mask, half_x)
    put(shape, S_HALF_Y, mask, half_y)
    put(shape, S_RHO, mask, rho)
    put(shape, S_THIN, mask, thin)
    slack = 1e-3 + 1e-5 * half_y + 1e-6 * tl.abs(y)
    first = tl.minimum(tl.maximum(y - half_y - slack - 0.5, 0.0), height - 1.0)
    last = tl.minimum(tl.maximum(y + half_y + slack - 0.5, 0.0), height - 1.0)
    put(shape, S_FIRST, mask, tl.where(mask, first, 0.0).to(tl.int32) // tile)
    put(shape, S_LAST, mask, tl.where(mask, last, 0.0).to(tl.int32) // tile)


@triton.jit(do_not_specialize=["n", "columns"])
def colour_kernel(
    cam,
    rows,
    keys,
    records,
    n,
    columns,
    COEFFICIENTS: tl.constexpr,
    REAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The colour in the records of the visible rows: by COEFFICIENTS of their SH coefficients. A
    kernel of its own, because it alone is compiled for each degree."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    at, record, mask = i * columns, records + i * RECORD, i < n
    mask = mask & (tl.load(keys + i, mask=mask, other=float("inf")) < float("inf"))
    x, y, z, _ = direction(cam, rows, at, mask, REAL)
    red, green, blue = x * 0.0 + 0.5, x * 0.0 + 0.5, x * 0.0 + 0.5
    for k in tl.static_range(COEFFICIENTS):
        value = basis(k, x, y, z)
        red += value * column(rows, at, mask, SH + 3 * k, REAL)
        green += value * column(rows, at, mask, SH + 3 * k + 1, REAL)
        blue += value * column(rows, at, mask, SH + 3 * k + 2, REAL)
    put(record, COLOUR, mask, tl.minimum(tl.maximum(red, 0.0), COLOUR_MAX))
    put(record, COLOUR + 1, mask, tl.minimum(tl.maximum(green, 0.0), COLOUR_MAX))
    put(record, COLOUR + 2, mask, tl.minimum(tl.maximum(blue, 0.0), COLOUR_MAX))


@triton.jit(do_not_specialize=["n", "columns", "used", "width", "height", "tile"])
def project_kernel(
    cam,
    rows,
    smoothing,
    n,
    columns,
    used,
    width,
    height,
    tile,
    records,
    shapes,
    keys,
    status,
    SMOOTH: tl.constexpr,
    ANTIALIAS: tl.constexpr,
    REAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Record (but for the colour), shape, key (depth, infinite where not visible) and status of
    each of n rows. rows [n, columns], of which `used` columns hold parameters. smoothing [n]."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask, at = i < n, i * columns
    good = drawable(rows, at, mask, smoothing, i, used, SMOOTH)
    filter_width = (i * 0).to(REAL)
    if SMOOTH:
        filter_width = tl.load(smoothing + i, mask=mask, other=0.0).to(REAL)
    x0, x1, x2, y0, y1, y2, softened, x, y, z = footprint_rows(
        cam, rows, at, good, filter_width, SMOOTH, REAL
    )
    a, b, c, det, _, kept = covariance(cam, x0, x1, x2, y0, y1, y2, ANTIALIAS, REAL)
    opacity = opacity_of(rows, at, good, REAL) * kept * softened
    shown = good & (z > number(cam, NEAR, REAL)) & (opacity >= ALPHA_MIN)
    shown = shown & (det > 0.0) & is_small(det)
    px = number(cam, FX, REAL) * x / z + number(cam, CX, REAL)
    py = number(cam, FY, REAL) * y / z + number(cam, CY, REAL)
    reach2 = 2.0 * (tl.log(opacity) - LOG_FAINTEST)
    reach2 = tl.where(reach2 > 0.0, reach2, reach2 * 0.0)
    half_x, half_y = tl.sqrt(reach2 * a), tl.sqrt(reach2 * c)
    shown = shown & (px + half_x >= 0.5) & (px - half_x <= width - 0.5)
    shown = shown & (py + half_y >= 0.5) & (py - half_y <= height - 0.5)
    half_x, half_y = tl.minimum(half_x, FAR), tl.minimum(half_y, FAR)
    px, py = held(px), held(py)
    record = records + i * RECORD
    put_record(record, shown, px, py, a, b, c, det, opacity, z, width, height)
    rho, thin = b / tl.sqrt(a) / tl.sqrt(c), tl.sqrt(det / a / c)
    put_shape(shapes + i * SHAPE, shown, px, py, half_x, half_y, rho, thin, height, tile)
    tl.store(keys + i, tl.where(shown, z.to(tl.float32), float("inf")), mask=mask)
    found = tl.where(good, tl.where(shown, VISIBLE, OUT_OF_VIEW), CULLED)
    tl.store(status + i, found.to(tl.int8), mask=mask)


@inner
def is_small(x):
    """The value, clamped so that its type can hold a product of it."""
    return x < 1e37 if x.dtype == tl.float32 else x < 1e300


@inner
def held(x):
    return tl.minimum(tl.maximum(x, -FAR), FAR)
