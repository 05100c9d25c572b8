"""Projection of splats to footprints, and its backward pass to their parameters, eight at a time.

Everything is in float64, which costs little beside blending and avoids overflow, cancellation in
the determinant, and loss of precision for distant means. Formulas as in `reference`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.raster.camera_row import (
    ANTIALIAS,
    CX,
    CY,
    DILATION,
    FX,
    FY,
    HEIGHT,
    HIGH_X,
    HIGH_Y,
    LOW_X,
    LOW_Y,
    NEAR,
    WIDTH,
    R,
    T,
)
from stages.raster.definition import (
    ALPHA_MIN,
    LOG_SCALE,
    LOG_SCALE_MAX,
    MEAN,
    OPACITY,
    QUATERNION_MIN,
    ROTATION,
    SCALE_MAX,
    SH,
)
from stages.raster.kernels.simd import kernel
from stages.raster.kernels.simd64 import (
    at,
    dand,
    deq,
    dexp,
    dge,
    dgt,
    dlog,
    dmax,
    dmin,
    dselect,
    dsqrt,
    gather8,
    put,
    scatter8,
    spread8,
)

# Scratch array for eight splats (float64[WORK_ROW x 8]), one for each thread: entry k of all lanes
# lies at 8 k. Filled by `footprint`, read by `footprint_gradient`.
X, Y, Z = 0, 1, 2  # position in the camera
V0, V1 = 3, 6  # rows of V = J W Q diag(s): W the camera rotation cam[R], Q the splat rotation
AXES = 9  # 9:18 W Q
SCALES = 18  # 18:21
CROSS = 21  # 21:24 V0 x V1
A, B, C, DET, MINORS = 24, 25, 26, 27, 28  # covariance in pixels (xx, xy, yy), determinant
FULL_OPACITY, COMPENSATION = 29, 30
NORM, QUATERNION = 31, 32  # 32:36 unit
SLOPE = 36  # 36:38 clamped x/z, y/z
INSIDE = 38  # 38:40 1 where the slope is inside its limits, else 0
SMOOTHING = 40  # opacity factor of the 3D smoothing filter
RATIOS = 41  # 41:44 scale before that filter over scale after it
WORK_ROW = 44

# Geometry record of a splat, float64[8]: mean in pixels; the three numbers of the exponent to base
# 2, (A u)^2 + (B (v - K u))^2, u along the axis of the larger variance (float32 could not hold the
# A^2 of a footprint of 1e19 pixels); log2 of the opacity; variances.
GEOMETRY_ROW = 8
GX, GY, GA, GB, GK, GL, GVX, GVY = range(8)
# Entries of 8 lanes that `footprint_gradient` writes: laid out like a gradient row, without its SH.
GRADIENTS = SH

_LOG2E = 1.0 / math.log(2.0)
_SQRT_LOG2E = math.sqrt(_LOG2E)
_FAINTEST = math.log(ALPHA_MIN)


@kernel
def drawable(rows, means, quaternions, log_scales, opacity_logits, smoothing):
    """Mask: all values but the colours are finite and in the range that can be drawn."""
    zero = spread8(0.0)
    good = dge(LOG_SCALE_MAX, gather8(log_scales, rows, 3, 0))
    largest = zero
    # 0 x value is 0 for finite values only
    nan_if_not_finite = 0.0 * gather8(opacity_logits, rows, 1, 0)
    for k in range(3):
        log_scale = gather8(log_scales, rows, 3, k)
        good = dand(good, dge(LOG_SCALE_MAX, log_scale))
        nan_if_not_finite = nan_if_not_finite + 0.0 * log_scale + 0.0 * gather8(means, rows, 3, k)
    for k in range(4):
        q = gather8(quaternions, rows, 4, k)
        nan_if_not_finite = nan_if_not_finite + 0.0 * q
        largest = dmax(largest, dmax(q, -q))
    if len(smoothing) > 0:
        width = gather8(smoothing, rows, 1, 0)
        good = dand(good, dand(dge(width, 0.0), dge(SCALE_MAX, width)))
    return dand(dand(good, deq(nan_if_not_finite, zero)), dge(largest, QUATERNION_MIN))


@kernel
def footprint(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w):
    """Fill the work `w` of eight rows; the mask of those in front of the camera.

    smoothing [N], or [0] for none: see `raster.smoothing`.
    """
    mx, my, mz = gather8(means, rows, 3, 0), gather8(means, rows, 3, 1), gather8(means, rows, 3, 2)
    x = cam[R] * mx + cam[R + 1] * my + cam[R + 2] * mz + cam[T]
    y = cam[R + 3] * mx + cam[R + 4] * my + cam[R + 5] * mz + cam[T + 1]
    z = cam[R + 6] * mx + cam[R + 7] * my + cam[R + 8] * mz + cam[T + 2]
    put(w, X, x)
    put(w, Y, y)
    put(w, Z, z)
    _axes(rows, cam, quaternions, w)
    slope_x, slope_y = x / z, y / z
    u = dmin(dmax(slope_x, cam[LOW_X]), cam[HIGH_X])
    v = dmin(dmax(slope_y, cam[LOW_Y]), cam[HIGH_Y])
    put(w, SLOPE, u)
    put(w, SLOPE + 1, v)
    put(w, INSIDE, dselect(deq(u, slope_x), 1.0, 0.0))
    put(w, INSIDE + 1, dselect(deq(v, slope_y), 1.0, 0.0))
    _scales(rows, log_scales, smoothing, w)
    _covariance(cam, u, v, z, w)
    put(w, FULL_OPACITY, 1.0 / (1.0 + dexp(-gather8(opacity_logits, rows, 1, 0))))
    return dgt(z, cam[NEAR])


@kernel
def _scales(rows, log_scales, smoothing, w):
    """Scales, widened by the smoothing filter f to sqrt(s^2 + f^2), and the factor by which that
    lowers the opacity: the product of s / sqrt(s^2 + f^2) over the axes. No square under- or
    overflows."""
    factor = spread8(1.0)
    for k in range(3):
        s = dexp(gather8(log_scales, rows, 3, k))
        if len(smoothing) > 0:
            f = gather8(smoothing, rows, 1, 0)
            larger, smaller = dmax(s, f), dmin(s, f)
            quotient = smaller / larger
            widened = larger * dsqrt(1.0 + quotient * quotient)
            put(w, RATIOS + k, s / widened)
            factor = factor * (s / widened)
            s = widened
        put(w, SCALES + k, s)
    put(w, SMOOTHING, factor)


@kernel
def _covariance(cam, u, v, z, w):
    """V = J W Q diag(s), cov2d = V V^T + e I, its determinant by Cauchy-Binet."""
    j00, j02 = cam[FX] / z, -cam[FX] * u / z
    j11, j12 = cam[FY] / z, -cam[FY] * v / z
    a, b, c = spread8(0.0), spread8(0.0), spread8(0.0)
    for k in range(3):
        s = at(w, SCALES + k)
        v0 = (j00 * at(w, AXES + k) + j02 * at(w, AXES + 6 + k)) * s
        v1 = (j11 * at(w, AXES + 3 + k) + j12 * at(w, AXES + 6 + k)) * s
        put(w, V0 + k, v0)
        put(w, V1 + k, v1)
        a, b, c = a + v0 * v0, b + v0 * v1, c + v1 * v1
    minors = spread8(0.0)
    for k in range(3):
        n, m = (k + 1) % 3, (k + 2) % 3
        minor = at(w, V0 + n) * at(w, V1 + m) - at(w, V0 + m) * at(w, V1 + n)
        put(w, CROSS + k, minor)
        minors = minors + minor * minor
    e = cam[DILATION]
    det = minors + e * (a + c) + e * e
    put(w, A, a + e)
    put(w, B, b)
    put(w, C, c + e)
    put(w, MINORS, minors)
    put(w, DET, det)
    if cam[ANTIALIAS] != 0.0:
        put(w, COMPENSATION, dsqrt(dmax(minors, 1e-60) / det))
    else:
        put(w, COMPENSATION, spread8(1.0))


@kernel
def _axes(rows, cam, quaternions, w):
    """W Q(q) into the scratch array; q is scaled before it is normalised: no square overflows."""
    q0, q1 = gather8(quaternions, rows, 4, 0), gather8(quaternions, rows, 4, 1)
    q2, q3 = gather8(quaternions, rows, 4, 2), gather8(quaternions, rows, 4, 3)
    top = dmax(dmax(dmax(q0, -q0), dmax(q1, -q1)), dmax(dmax(q2, -q2), dmax(q3, -q3)))
    q0, q1, q2, q3 = q0 / top, q1 / top, q2 / top, q3 / top
    norm = dsqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q0, q1, q2, q3 = q0 / norm, q1 / norm, q2 / norm, q3 / norm
    put(w, NORM, norm * top)
    put(w, QUATERNION, q0)
    put(w, QUATERNION + 1, q1)
    put(w, QUATERNION + 2, q2)
    put(w, QUATERNION + 3, q3)
    r00 = 1.0 - 2.0 * (q2 * q2 + q3 * q3)
    r01 = 2.0 * (q1 * q2 - q0 * q3)
    r02 = 2.0 * (q1 * q3 + q0 * q2)
    r10 = 2.0 * (q1 * q2 + q0 * q3)
    r11 = 1.0 - 2.0 * (q1 * q1 + q3 * q3)
    r12 = 2.0 * (q2 * q3 - q0 * q1)
    r20 = 2.0 * (q1 * q3 - q0 * q2)
    r21 = 2.0 * (q2 * q3 + q0 * q1)
    r22 = 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    for row in range(3):
        c0, c1, c2 = cam[R + 3 * row], cam[R + 3 * row + 1], cam[R + 3 * row + 2]
        put(w, AXES + 3 * row, c0 * r00 + c1 * r10 + c2 * r20)
        put(w, AXES + 3 * row + 1, c0 * r01 + c1 * r11 + c2 * r21)
        put(w, AXES + 3 * row + 2, c0 * r02 + c1 * r12 + c2 * r22)


@kernel
def used_opacity(w):
    """Opacity as it is drawn: lowered by antialiasing and smoothing."""
    return at(w, FULL_OPACITY) * at(w, COMPENSATION) * at(w, SMOOTHING)


@kernel
def geometry_records(cam, w, rows, geometry):
    """Write geometry[rows] from their work `w`; return the mask of rows that touch a pixel of the
    picture."""
    opacity = used_opacity(w)
    a, b, c, det, z = at(w, A), at(w, B), at(w, C), at(w, DET), at(w, Z)
    drawn = dand(dge(opacity, ALPHA_MIN), dand(dgt(1e300, det), dgt(det, 0.0)))
    x = cam[FX] * at(w, X) / z + cam[CX]
    y = cam[FY] * at(w, Y) / z + cam[CY]
    level = dlog(dmax(opacity, ALPHA_MIN))
    reach2 = 2.0 * (level - _FAINTEST)
    half_x, half_y = dsqrt(reach2 * a), dsqrt(reach2 * c)
    drawn = dand(drawn, dand(dge(x + half_x, 0.5), dge(cam[WIDTH] - 0.5, x - half_x)))
    drawn = dand(drawn, dand(dge(y + half_y, 0.5), dge(cam[HEIGHT] - 0.5, y - half_y)))
    major = dmax(a, c)
    scatter8(geometry, rows, GEOMETRY_ROW, GX, x)
    scatter8(geometry, rows, GEOMETRY_ROW, GY, y)
    scatter8(geometry, rows, GEOMETRY_ROW, GA, dsqrt(0.5 / major) * _SQRT_LOG2E)
    scatter8(geometry, rows, GEOMETRY_ROW, GB, dsqrt(0.5 * major / det) * _SQRT_LOG2E)
    scatter8(geometry, rows, GEOMETRY_ROW, GK, b / major)
    scatter8(geometry, rows, GEOMETRY_ROW, GL, level * _LOG2E)
    scatter8(geometry, rows, GEOMETRY_ROW, GVX, a)
    scatter8(geometry, rows, GEOMETRY_ROW, GVY, c)
    return drawn


@kernel
def sums_origin(geometry, row, width, height):
    """(o, p, q): origin of the offsets u' and t' in the backward pass, pixels.

    u' = major - o, t' = (minor - q) - K (major - p), major and minor a pixel's coordinates along
    the axis of the larger variance and along the other. The origin is the mean if it is in the
    picture, otherwise the point of the picture where the offsets are smallest.
    Sums of offsets from a mean 1e5 pixels away would keep few digits of the pixels' positions,
    which decide the gradient along the viewing ray.
    """
    x, y = geometry[row, GX], geometry[row, GY]
    wide = geometry[row, GVX] >= geometry[row, GVY]
    major, minor = (x, y) if wide else (y, x)
    if 0.0 <= x <= width and 0.0 <= y <= height:
        return major, major, minor
    across, down = np.float64(width), np.float64(height)
    if not wide:
        across, down = down, across
    k = geometry[row, GK]
    far, near = (across, 0.0) if k > 0.0 else (0.0, across)
    o = min(max(major, 0.0), across)
    if -minor - k * (far - major) > 0.0:  # the whole picture lies on one side of the axis
        return o, far, 0.0
    if down - minor - k * (near - major) < 0.0:  # or on the other
        return o, near, down
    return o, major, minor


@kernel
def footprint_gradient(cam, w, g_x, g_y, g_a, g_b, g_k, g_depth, g_opacity, smoothed, out):
    """Chain rule from the footprints of eight splats to their parameters.

    Gradients of mean x, mean y (px), of A, B, K of the exponent A u^2 + B (v - K u)^2, of
    ln(1 / z) through that exponent (g_depth), and of the drawn opacity.
    smoothed: whether a smoothing filter was used.
    out (work of GRADIENTS entries): gradients of mean, quaternion, log-scales, opacity logit.
    """
    cov_xx, cov_xy, cov_yy, det = at(w, A), at(w, B), at(w, C), at(w, DET)
    major = dmax(cov_xx, cov_yy)
    g_major = (0.5 * g_b / det) - (0.5 * g_a + g_k * cov_xy) / (major * major)
    g_cov = g_k / major
    g_det = -0.5 * g_b * major / (det * det)
    wide = dge(cov_xx, cov_yy)
    g_var_x, g_var_y = dselect(wide, g_major, 0.0), dselect(wide, 0.0, g_major)
    g_minors = spread8(0.0)
    opacity, drawn_opacity = at(w, FULL_OPACITY), used_opacity(w)
    e = cam[DILATION]
    if cam[ANTIALIAS] != 0.0:
        g_compensation = g_opacity * opacity * at(w, SMOOTHING)
        compensation, minors = at(w, COMPENSATION), at(w, MINORS)
        g_det = g_det - 0.5 * g_compensation * compensation / det
        thick = dgt(minors, 1e-60)
        g_minors = dselect(thick, 0.5 * g_compensation / (compensation * det), 0.0)
        # d ln(compensation) / d ln(1 / z): the minors grow as (1 / z)^4
        growth = dselect(thick, e * (cov_xx + cov_yy), e * (cov_xx + cov_yy) - 2.0 * det)
        g_depth = g_depth + g_compensation * compensation * growth / det
    put(out, OPACITY, g_opacity * drawn_opacity * (1.0 - opacity))
    g_minors = g_minors + g_det
    e2 = 2.0 * e * g_det
    z = at(w, Z)
    fx, fy = cam[FX], cam[FY]
    slope_x, slope_y = at(w, SLOPE), at(w, SLOPE + 1)
    j00, j02, j11, j12 = fx / z, -fx * slope_x / z, fy / z, -fy * slope_y / z
    g02, g12 = spread8(0.0), spread8(0.0)
    for k in range(3):
        n, m = (k + 1) % 3, (k + 2) % 3
        v0, v1 = at(w, V0 + k), at(w, V1 + k)
        # d|V0 x V1|^2 / dV0 = 2 V1 x (V0 x V1), and / dV1 = 2 (V0 x V1) x V0
        d0 = at(w, V1 + n) * at(w, CROSS + m) - at(w, V1 + m) * at(w, CROSS + n)
        d1 = at(w, CROSS + n) * at(w, V0 + m) - at(w, CROSS + m) * at(w, V0 + n)
        g_v0 = (2.0 * g_var_x + e2) * v0 + g_cov * v1 + 2.0 * g_minors * d0
        g_v1 = (2.0 * g_var_y + e2) * v1 + g_cov * v0 + 2.0 * g_minors * d1
        g_log_scale = g_v0 * v0 + g_v1 * v1
        if smoothed:
            kept = at(w, RATIOS + k) * at(w, RATIOS + k)
            g_log_scale = g_log_scale * kept + g_opacity * drawn_opacity * (1.0 - kept)
        put(out, LOG_SCALE + k, g_log_scale)
        t0, t1 = g_v0 * at(w, SCALES + k), g_v1 * at(w, SCALES + k)
        z_axis = at(w, AXES + 6 + k)
        g02, g12 = g02 + t0 * z_axis, g12 + t1 * z_axis
        # from here on these entries hold the gradient of W Q
        put(w, AXES + k, j00 * t0)
        put(w, AXES + 3 + k, j11 * t1)
        put(w, AXES + 6 + k, j02 * t0 + j12 * t1)
    _quaternion_gradient(cam, w, out)
    _mean_gradient(cam, w, g_x, g_y, g02, g12, g_depth, out)


@kernel
def _mean_gradient(cam, w, g_px, g_py, g02, g12, g_depth, out):
    """out[MEAN] from the gradients of the projected mean, of the Jacobian's last column, and of
    ln(1 / z) at fixed slopes."""
    fx, fy = cam[FX], cam[FY]
    z, u, v = at(w, Z), at(w, SLOPE), at(w, SLOPE + 1)
    # a slope inside its limits moves with the mean; a clamped one does not
    g_u = dselect(dgt(at(w, INSIDE), 0.5), -g02 * fx / z, 0.0)
    g_v = dselect(dgt(at(w, INSIDE + 1), 0.5), -g12 * fy / z, 0.0)
    g_x, g_y = (g_px * fx + g_u) / z, (g_py * fy + g_v) / z
    g_z = -(g_depth + g_u * u + g_v * v) / z
    for k in range(3):
        put(out, MEAN + k, cam[R + k] * g_x + cam[R + 3 + k] * g_y + cam[R + 6 + k] * g_z)


@kernel
def _quaternion_gradient(cam, w, out):
    """out[ROTATION] from the gradient of W Q, which is in the scratch array's AXES."""
    q0, q1 = at(w, QUATERNION), at(w, QUATERNION + 1)
    q2, q3 = at(w, QUATERNION + 2), at(w, QUATERNION + 3)
    g0, g1, g2 = at(w, AXES), at(w, AXES + 3), at(w, AXES + 6)
    r00 = cam[R] * g0 + cam[R + 3] * g1 + cam[R + 6] * g2
    r10 = cam[R + 1] * g0 + cam[R + 4] * g1 + cam[R + 7] * g2
    r20 = cam[R + 2] * g0 + cam[R + 5] * g1 + cam[R + 8] * g2
    g0, g1, g2 = at(w, AXES + 1), at(w, AXES + 4), at(w, AXES + 7)
    r01 = cam[R] * g0 + cam[R + 3] * g1 + cam[R + 6] * g2
    r11 = cam[R + 1] * g0 + cam[R + 4] * g1 + cam[R + 7] * g2
    r21 = cam[R + 2] * g0 + cam[R + 5] * g1 + cam[R + 8] * g2
    g0, g1, g2 = at(w, AXES + 2), at(w, AXES + 5), at(w, AXES + 8)
    r02 = cam[R] * g0 + cam[R + 3] * g1 + cam[R + 6] * g2
    r12 = cam[R + 1] * g0 + cam[R + 4] * g1 + cam[R + 7] * g2
    r22 = cam[R + 2] * g0 + cam[R + 5] * g1 + cam[R + 8] * g2
    n0 = 2.0 * (q1 * (r21 - r12) + q2 * (r02 - r20) + q3 * (r10 - r01))
    n1 = 2.0 * (q2 * (r01 + r10) + q3 * (r02 + r20) + q0 * (r21 - r12)) - 4.0 * q1 * (r11 + r22)
    n2 = 2.0 * (q1 * (r01 + r10) + q3 * (r12 + r21) + q0 * (r02 - r20)) - 4.0 * q2 * (r00 + r22)
    n3 = 2.0 * (q1 * (r02 + r20) + q2 * (r12 + r21) + q0 * (r10 - r01)) - 4.0 * q3 * (r00 + r11)
    along = n0 * q0 + n1 * q1 + n2 * q2 + n3 * q3
    norm = at(w, NORM)
    put(out, ROTATION, (n0 - along * q0) / norm)
    put(out, ROTATION + 1, (n1 - along * q1) / norm)
    put(out, ROTATION + 2, (n2 - along * q2) / norm)
    put(out, ROTATION + 3, (n3 - along * q3) / norm)
