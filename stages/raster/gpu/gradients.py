"""Gradients of the splats' parameters, from the sums that blending writes for each (splat, tile).

The chain rule is that of `cpu.projection` and `cpu.splat_kernels`, where it is explained.
"""

from __future__ import annotations

import triton
import triton.language as tl

from stages.raster.gpu.blend import S_1, S_RED, S_T, S_TT, S_U, S_UT, S_UU, SUMS
from stages.raster.gpu.geometry import (
    CX,
    CY,
    DILATION,
    FX,
    FY,
    LOG_SCALE,
    MEAN,
    OPACITY,
    ROTATION,
    SH,
    axis_x,
    axis_y,
    axis_z,
    basis,
    basis_slope,
    column,
    cross,
    direction,
    number,
    scale,
    slopes,
    turned_back,
    unit_quaternion,
)
from stages.raster.gpu.inner import inner, sum_of, top_of
from stages.raster.gpu.project import (
    COLOUR,
    ORIGIN,
    ORIGIN_CUT,
    RECORD,
    covariance,
    footprint_rows,
    held,
    opacity_of,
)

LARGEST_KEPT = tl.constexpr(3.4e38)  # no gradient becomes infinite
BRIGHTEST = tl.constexpr(1.0000000200408773e20)  # COLOUR_MAX in float32


@triton.jit(do_not_specialize=["n", "entries"])
def sum_kernel(
    raw,
    firsts,
    counts,
    sums,
    n,
    entries,
    WIDTH: tl.constexpr,
    REAL: tl.constexpr,
    BLOCK: tl.constexpr,
    LANES: tl.constexpr,
):
    """sums [n, WIDTH] REAL: each splat's rows of raw [entries, WIDTH], added up in a fixed order.

    firsts [n], counts [n]: first row and number of rows of each splat. entries: rows that `raw`
    has room for.
    """
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    first = tl.load(firsts + i, mask=i < n, other=0)
    count = tl.load(counts + i, mask=i < n, other=0)
    most = top_of(count, 0)
    lane = tl.arange(0, LANES)
    for k in tl.static_range(WIDTH):
        total = tl.zeros([BLOCK, LANES], REAL)
        for step in range(0, most, LANES):
            slot = first[:, None] + step + lane[None, :]
            there = ((step + lane)[None, :] < count[:, None]) & (slot < entries)
            total += tl.load(raw + slot * WIDTH + k, mask=there, other=0.0).to(REAL)
        tl.store(sums + i * WIDTH + k, sum_of(total, 1), mask=i < n)


@inner
def store_gradient(out, k, mask, value):
    value = tl.minimum(tl.maximum(value, -LARGEST_KEPT), LARGEST_KEPT)
    tl.store(out + k, value.to(tl.float32), mask=mask)


@inner
def axis_gradient(v0, v1, d0, d1, g_var_x, g_var_y, g_cov, g_minors):
    """(gradients of an entry of V0 and of V1) from those of the covariance and its determinant."""
    g_v0 = 2.0 * g_var_x * v0 + g_cov * v1 + 2.0 * g_minors * d0
    g_v1 = 2.0 * g_var_y * v1 + g_cov * v0 + 2.0 * g_minors * d1
    return g_v0, g_v1


@inner
def scale_gradient(out, k, mask, by_size, by_opacity, ratio):
    kept = ratio * ratio
    store_gradient(out, LOG_SCALE + k, mask, by_size * kept + by_opacity * (1.0 - kept))


@inner
def rotation_gradient(out, mask, q0, q1, q2, q3, norm, r00, r10, r20, r01, r11, r21, r02, r12, r22):
    """Gradient of a quaternion from the gradient of its rotation matrix."""
    n0 = 2.0 * (q1 * (r21 - r12) + q2 * (r02 - r20) + q3 * (r10 - r01))
    n1 = 2.0 * (q2 * (r01 + r10) + q3 * (r02 + r20) + q0 * (r21 - r12)) - 4.0 * q1 * (r11 + r22)
    n2 = 2.0 * (q1 * (r01 + r10) + q3 * (r12 + r21) + q0 * (r02 - r20)) - 4.0 * q2 * (r00 + r22)
    n3 = 2.0 * (q1 * (r02 + r20) + q2 * (r12 + r21) + q0 * (r10 - r01)) - 4.0 * q3 * (r00 + r11)
    along = n0 * q0 + n1 * q1 + n2 * q2 + n3 * q3
    store_gradient(out, ROTATION, mask, (n0 - along * q0) / norm)
    store_gradient(out, ROTATION + 1, mask, (n1 - along * q1) / norm)
    store_gradient(out, ROTATION + 2, mask, (n2 - along * q2) / norm)
    store_gradient(out, ROTATION + 3, mask, (n3 - along * q3) / norm)


@triton.jit(do_not_specialize=["n", "columns"])
def colour_gradient_kernel(
    cam,
    rows,
    keys,
    records,
    sums,
    n,
    columns,
    out,
    COEFFICIENTS: tl.constexpr,
    REAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """SH gradients of the visible rows into out [n, columns], and into its columns of the mean what
    the viewing directions add to that. `splat_gradient_kernel` adds the rest."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask, at = i < n, i * columns
    mask = mask & (tl.load(keys + i, mask=mask, other=float("inf")) < float("inf"))
    record, sums, out = records + i * RECORD, sums + i * SUMS, out + at
    x, y, z, distance = direction(cam, rows, at, mask, REAL)
    g_r = shown_colour(record, sums, 0, mask)
    g_g = shown_colour(record, sums, 1, mask)
    g_b = shown_colour(record, sums, 2, mask)
    gx, gy, gz = x * 0.0, x * 0.0, x * 0.0
    for k in tl.static_range(COEFFICIENTS):
        value = basis(k, x, y, z)
        store_gradient(out, SH + 3 * k, mask, g_r * value)
        store_gradient(out, SH + 3 * k + 1, mask, g_g * value)
        store_gradient(out, SH + 3 * k + 2, mask, g_b * value)
        if k > 0:
            weight = g_r * column(rows, at, mask, SH + 3 * k, REAL)
            weight += g_g * column(rows, at, mask, SH + 3 * k + 1, REAL)
            weight += g_b * column(rows, at, mask, SH + 3 * k + 2, REAL)
            by_x, by_y, by_z = basis_slope(k, x, y, z)
            gx += weight * by_x
            gy += weight * by_y
            gz += weight * by_z
    along = gx * x + gy * y + gz * z
    store_gradient(out, MEAN, mask, (gx - along * x) / distance)
    store_gradient(out, MEAN + 1, mask, (gy - along * y) / distance)
    store_gradient(out, MEAN + 2, mask, (gz - along * z) / distance)


@inner
def shown_colour(record, sums, channel, mask):
    """The gradient of a colour; 0 where the colour is clamped."""
    value = tl.load(record + COLOUR + channel, mask=mask, other=0.0)
    g = tl.load(sums + S_RED + channel, mask=mask, other=0.0)
    return tl.where((value > 0.0) & (value < BRIGHTEST), g, 0.0)


@inner
def exponent_gradient(cam, record, sums, mask, x, y, a, b, c, det, REAL: tl.constexpr):
    """(gradients of mean x, mean y, of A, B, K and of ln(1 / z) through the exponent
    A u^2 + B (v - K u)^2, the sum over pixels of the exponent's own)."""
    tall = c > a
    major_variance = tl.maximum(a, c)
    k = b / major_variance
    by_a, by_b = 0.5 / major_variance, 0.5 * major_variance / det
    cx, cy = number(cam, CX, REAL), number(cam, CY, REAL)
    major, minor = tl.where(tall, y, x), tl.where(tall, x, y)
    c_major, c_minor = tl.where(tall, cy, cx), tl.where(tall, cx, cy)
    o = tl.load(record + ORIGIN, mask=mask, other=0.0).to(REAL)
    cut = tl.load(record + ORIGIN_CUT, mask=mask, other=0.0).to(REAL)
    du, dt = o - major, cut - (minor - k * major)
    s_1 = tl.load(sums + S_1, mask=mask, other=0.0)
    near_u = tl.load(sums + S_U, mask=mask, other=0.0)
    near_t = tl.load(sums + S_T, mask=mask, other=0.0)
    s_u, s_t = near_u + du * s_1, near_t + dt * s_1
    by_u = tl.load(sums + S_UU, mask=mask, other=0.0) + du * near_u
    by_t = tl.load(sums + S_TT, mask=mask, other=0.0) + dt * near_t
    s_uu, s_tt = by_u + du * s_u, by_t + dt * s_t
    s_ut = tl.load(sums + S_UT, mask=mask, other=0.0) + du * near_t + dt * s_u
    along, across = 2.0 * (by_b * k * s_t - by_a * s_u), -2.0 * by_b * s_t
    q_p = by_a * (by_u + (o - c_major) * s_u)
    q_p += by_b * (by_t + (cut - (c_minor - k * c_major)) * s_t)
    q_q = by_a * by_a * s_uu - 2.0 * by_a * by_b * k * s_ut
    q_q += by_b * by_b * (1.0 + k * k) * s_tt
    g_near = 4.0 * number(cam, DILATION, REAL) * q_q - 2.0 * q_p
    g_x, g_y = tl.where(tall, across, along), tl.where(tall, along, across)
    return g_x, g_y, s_uu, s_tt, -2.0 * by_b * s_ut, g_near, s_1


@inner
def covariance_gradient(cam, shape, g_shape, g_drawn, ANTIALIAS: tl.constexpr, REAL: tl.constexpr):
    """(gradients of both variances, of the covariance and of the minors; what antialiasing adds to
    the gradient of ln(1 / z)) from those of the exponent and of the logarithm of the drawn
    opacity. shape: see `covariance`. g_shape: of the exponent's A, B and K."""
    a, b, c, det, minors, kept = shape
    g_a, g_b, g_k = g_shape
    e, major, wide = number(cam, DILATION, REAL), tl.maximum(a, c), a >= c
    g_major = 0.5 * g_b / det - (0.5 * g_a + g_k * b) / (major * major)
    g_cov, g_det = g_k / major, -0.5 * g_b * major / (det * det)
    g_minors, g_near = det * 0.0, det * 0.0
    if ANTIALIAS:
        g_det -= 0.5 * g_drawn / det
        thick = minors > 1e-60
        g_minors = tl.where(thick, 0.5 * g_drawn / (kept * kept * det), 0.0)
        growth = tl.where(thick, e * (a + c), e * (a + c) - 2.0 * det)
        g_near = g_drawn * growth / det
    g_var_x = tl.where(wide, g_major, 0.0) + e * g_det
    g_var_y = tl.where(wide, 0.0, g_major) + e * g_det
    return g_var_x, g_var_y, g_cov, g_minors + g_det, g_near


@inner
def shape_gradient(
    cam, rows, at, mask, out, width, v0, v1, g, jacobian, g_drawn, SMOOTH: tl.constexpr,
    REAL: tl.constexpr,
):  # fmt: skip
    """Gradients of scales and rotation into `out`; returns those of the Jacobian's last column.
    v0, v1: rows of V, as `footprint_rows` gives them. g: as `covariance_gradient` gives it."""
    x0, x1, x2 = v0
    y0, y1, y2 = v1
    j00, j02, j11, j12 = jacobian
    g_var_x, g_var_y, g_cov, g_minors = g
    m0, m1, m2 = cross(x0, x1, x2, y0, y1, y2)
    d0, d1, d2 = cross(y0, y1, y2, m0, m1, m2)
    e0, e1, e2 = cross(m0, m1, m2, x0, x1, x2)
    w0, w1, w2, w3, norm = unit_quaternion(rows, at, mask, REAL)
    g0, g1 = axis_gradient(x0, y0, d0, e0, g_var_x, g_var_y, g_cov, g_minors)
    s, ratio = scale(rows, at, mask, width, 0, SMOOTH, REAL)
    scale_gradient(out, 0, mask, g0 * x0 + g1 * y0, g_drawn, ratio)
    _, _, deep = axis_x(cam, w0, w1, w2, w3, REAL)
    g0, g1 = g0 * s, g1 * s
    g02, g12 = g0 * deep, g1 * deep
    r00, r10, r20 = turned_back(cam, j00 * g0, j11 * g1, j02 * g0 + j12 * g1, REAL)
    g0, g1 = axis_gradient(x1, y1, d1, e1, g_var_x, g_var_y, g_cov, g_minors)
    s, ratio = scale(rows, at, mask, width, 1, SMOOTH, REAL)
    scale_gradient(out, 1, mask, g0 * x1 + g1 * y1, g_drawn, ratio)
    _, _, deep = axis_y(cam, w0, w1, w2, w3, REAL)
    g0, g1 = g0 * s, g1 * s
    g02, g12 = g02 + g0 * deep, g12 + g1 * deep
    r01, r11, r21 = turned_back(cam, j00 * g0, j11 * g1, j02 * g0 + j12 * g1, REAL)
    g0, g1 = axis_gradient(x2, y2, d2, e2, g_var_x, g_var_y, g_cov, g_minors)
    s, ratio = scale(rows, at, mask, width, 2, SMOOTH, REAL)
    scale_gradient(out, 2, mask, g0 * x2 + g1 * y2, g_drawn, ratio)
    _, _, deep = axis_z(cam, w0, w1, w2, w3, REAL)
    g0, g1 = g0 * s, g1 * s
    r02, r12, r22 = turned_back(cam, j00 * g0, j11 * g1, j02 * g0 + j12 * g1, REAL)
    rotation_gradient(out, mask, w0, w1, w2, w3, norm, r00, r10, r20, r01, r11, r21, r02, r12, r22)
    return g02 + g0 * deep, g12 + g1 * deep


@triton.jit(do_not_specialize=["n", "columns"])
def splat_gradient_kernel(
    cam,
    rows,
    smoothing,
    keys,
    records,
    sums,
    n,
    columns,
    out,
    means2d,
    SMOOTH: tl.constexpr,
    ANTIALIAS: tl.constexpr,
    REAL: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """out [n, columns], means2d [n, 2]: gradients of the visible rows, but for those that
    `colour_gradient_kernel` left in `out` before. Other rows are left as they are."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = i < n
    mask = mask & (tl.load(keys + i, mask=mask, other=float("inf")) < float("inf"))
    at = i * columns
    record, sums, out = records + i * RECORD, sums + i * SUMS, out + at
    width = (i * 0).to(REAL)
    if SMOOTH:
        width = tl.load(smoothing + i, mask=mask, other=0.0).to(REAL)
    x0, x1, x2, y0, y1, y2, _, x, y, z = footprint_rows(cam, rows, at, mask, width, SMOOTH, REAL)
    a, b, c, det, minors, kept = covariance(cam, x0, x1, x2, y0, y1, y2, ANTIALIAS, REAL)
    fx, fy = number(cam, FX, REAL), number(cam, FY, REAL)
    px, py = held(fx * x / z + number(cam, CX, REAL)), held(fy * y / z + number(cam, CY, REAL))
    g_x, g_y, g_a, g_b, g_k, g_near, s_1 = exponent_gradient(
        cam, record, sums, mask, px, py, a, b, c, det, REAL
    )
    tl.store(means2d + i * 2, g_x.to(tl.float32), mask=mask)
    tl.store(means2d + i * 2 + 1, g_y.to(tl.float32), mask=mask)
    g_drawn = -s_1  # gradient of the logarithm of the drawn opacity
    store_gradient(out, OPACITY, mask, g_drawn * (1.0 - opacity_of(rows, at, mask, REAL)))
    g_var_x, g_var_y, g_cov, g_minors, nearer = covariance_gradient(
        cam, (a, b, c, det, minors, kept), (g_a, g_b, g_k), g_drawn, ANTIALIAS, REAL
    )
    g_near += nearer
    u, v, in_u, in_v = slopes(cam, x, y, z, REAL)
    j00, j02, j11, j12 = fx / z, -fx * u / z, fy / z, -fy * v / z
    v0, v1, g = (x0, x1, x2), (y0, y1, y2), (g_var_x, g_var_y, g_cov, g_minors)
    jacobian = (j00, j02, j11, j12)
    g02, g12 = shape_gradient(
        cam, rows, at, mask, out, width, v0, v1, g, jacobian, g_drawn, SMOOTH, REAL
    )
    # a slope inside its limits moves with the mean; a clamped one does not
    g_u, g_v = tl.where(in_u, -g02 * fx / z, 0.0), tl.where(in_v, -g12 * fy / z, 0.0)
    by_x, by_y = (g_x * fx + g_u) / z, (g_y * fy + g_v) / z
    mx, my, mz = turned_back(cam, by_x, by_y, -(g_near + g_u * u + g_v * v) / z, REAL)
    store_gradient(out, MEAN, mask, mx + column(out, 0, mask, MEAN, REAL))
    store_gradient(out, MEAN + 1, mask, my + column(out, 0, mask, MEAN + 1, REAL))
    store_gradient(out, MEAN + 2, mask, mz + column(out, 0, mask, MEAN + 2, REAL))
