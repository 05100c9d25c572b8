"""Footprints of splats: what the forward and the backward pass both compute.

Formulas as in `reference`, one splat in each lane. REAL is the type of all numbers: float64, or
float32 in a test that measures what it costs. A row of parameters has the columns of a row of
gradients (`definition`).
"""

from __future__ import annotations

import triton.language as tl

from stages.raster import camera_row, definition
from stages.raster.gpu.inner import inner, sum_of
from stages.raster.sh import C0, C1, C2, C3

SHIFT, NEAR = tl.constexpr(camera_row.T), tl.constexpr(camera_row.NEAR)
FX, FY = tl.constexpr(camera_row.FX), tl.constexpr(camera_row.FY)
CX, CY = tl.constexpr(camera_row.CX), tl.constexpr(camera_row.CY)
LOW_X, HIGH_X = tl.constexpr(camera_row.LOW_X), tl.constexpr(camera_row.HIGH_X)
LOW_Y, HIGH_Y = tl.constexpr(camera_row.LOW_Y), tl.constexpr(camera_row.HIGH_Y)
DILATION, CAMERA_CENTRE = tl.constexpr(camera_row.DILATION), tl.constexpr(camera_row.CAMERA_CENTRE)
MEAN, ROTATION = tl.constexpr(definition.MEAN), tl.constexpr(definition.ROTATION)
LOG_SCALE, OPACITY = tl.constexpr(definition.LOG_SCALE), tl.constexpr(definition.OPACITY)
SH = tl.constexpr(definition.SH)
ALPHA_MIN, ALPHA_MAX = tl.constexpr(definition.ALPHA_MIN), tl.constexpr(definition.ALPHA_MAX)
COLOUR_MAX = tl.constexpr(definition.COLOUR_MAX)
LOG_SCALE_MAX = tl.constexpr(definition.LOG_SCALE_MAX)
SCALE_MAX = tl.constexpr(definition.SCALE_MAX)
QUATERNION_MIN = tl.constexpr(definition.QUATERNION_MIN)
LARGEST = tl.constexpr(3.4028234663852886e38)
LOG2E = tl.constexpr(1.4426950408889634)
GROUP = tl.constexpr(16)  # columns of a row that are looked at together

K0, K1 = tl.constexpr(C0), tl.constexpr(C1)
K20, K21, K22 = (tl.constexpr(c) for c in C2)
K30, K31, K32, K33, K34 = (tl.constexpr(c) for c in C3)


@inner
def number(cam, k, REAL: tl.constexpr):
    """Entry k of the camera's row."""
    return tl.load(cam + k).to(REAL)


@inner
def column(rows, at, mask, k, REAL: tl.constexpr):
    """Column k of parameter rows that begin at offsets `at`; 0 where masked."""
    return tl.load(rows + at + k, mask=mask, other=0.0).to(REAL)


@inner
def is_finite(x):
    return tl.abs(x) <= LARGEST


@inner
def drawable(rows, at, mask, smoothing, i, used, SMOOTH: tl.constexpr):
    """Whether a row can be drawn at all: see `reference.drawable`. Its `used` columns are float32;
    GROUP neighbours are read at once, by neighbouring lanes."""
    wrong, k = (at * 0).to(tl.int32), tl.expand_dims(tl.arange(0, GROUP), 0)
    here, some = tl.expand_dims(rows + at, 1), tl.expand_dims(mask, 1)
    for first in range(0, used, GROUP):
        value = tl.load(here + (first + k), mask=some & (first + k < used), other=0.0)
        wrong += sum_of(tl.where(is_finite(value), 0, 1), 1)
    good = mask & (wrong == 0)
    for axis in tl.static_range(3):
        good = good & (tl.load(rows + at + LOG_SCALE + axis, mask=mask, other=0.0) <= LOG_SCALE_MAX)
    q0, q1, q2, q3 = quaternion(rows, at, mask, tl.float64)  # the bound is not exact in float32
    good = good & (largest4(q0, q1, q2, q3) >= QUATERNION_MIN)
    if SMOOTH:
        width = tl.load(smoothing + i, mask=mask, other=0.0).to(tl.float64)
        good = good & (width >= 0.0) & (width <= SCALE_MAX)
    return good


@inner
def quaternion(rows, at, mask, REAL: tl.constexpr):
    q0 = column(rows, at, mask, ROTATION, REAL)
    q1 = column(rows, at, mask, ROTATION + 1, REAL)
    q2 = column(rows, at, mask, ROTATION + 2, REAL)
    q3 = column(rows, at, mask, ROTATION + 3, REAL)
    return q0, q1, q2, q3


@inner
def largest4(a, b, c, d):
    return tl.maximum(tl.maximum(tl.abs(a), tl.abs(b)), tl.maximum(tl.abs(c), tl.abs(d)))


@inner
def unit_quaternion(rows, at, mask, REAL: tl.constexpr):
    """(w, x, y, z, norm): scaled before it is normalised, so that no square overflows."""
    q0, q1, q2, q3 = quaternion(rows, at, mask, REAL)
    top = largest4(q0, q1, q2, q3)
    q0, q1, q2, q3 = q0 / top, q1 / top, q2 / top, q3 / top
    norm = tl.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return q0 / norm, q1 / norm, q2 / norm, q3 / norm, norm * top


@inner
def position(cam, rows, at, mask, REAL: tl.constexpr):
    """(x, y, z) in the camera."""
    mx = column(rows, at, mask, MEAN, REAL)
    my = column(rows, at, mask, MEAN + 1, REAL)
    mz = column(rows, at, mask, MEAN + 2, REAL)
    x, y, z = turned(cam, mx, my, mz, REAL)
    x += number(cam, SHIFT, REAL)
    y += number(cam, SHIFT + 1, REAL)
    z += number(cam, SHIFT + 2, REAL)
    return x, y, z


@inner
def turned(cam, x, y, z, REAL: tl.constexpr):
    """A vector of the world in camera axes."""
    a = number(cam, 0, REAL) * x + number(cam, 1, REAL) * y + number(cam, 2, REAL) * z
    b = number(cam, 3, REAL) * x + number(cam, 4, REAL) * y + number(cam, 5, REAL) * z
    c = number(cam, 6, REAL) * x + number(cam, 7, REAL) * y + number(cam, 8, REAL) * z
    return a, b, c


@inner
def turned_back(cam, a, b, c, REAL: tl.constexpr):
    """A vector in camera axes, in world axes."""
    x = number(cam, 0, REAL) * a + number(cam, 3, REAL) * b + number(cam, 6, REAL) * c
    y = number(cam, 1, REAL) * a + number(cam, 4, REAL) * b + number(cam, 7, REAL) * c
    z = number(cam, 2, REAL) * a + number(cam, 5, REAL) * b + number(cam, 8, REAL) * c
    return x, y, z


@inner
def slopes(cam, x, y, z, REAL: tl.constexpr):
    """(u, v, whether u, whether v is inside): x/z and y/z, clamped to their limits."""
    slope_x, slope_y = x / z, y / z
    u = tl.minimum(tl.maximum(slope_x, number(cam, LOW_X, REAL)), number(cam, HIGH_X, REAL))
    v = tl.minimum(tl.maximum(slope_y, number(cam, LOW_Y, REAL)), number(cam, HIGH_Y, REAL))
    return u, v, u == slope_x, v == slope_y


@inner
def scale(rows, at, mask, width, k, SMOOTH: tl.constexpr, REAL: tl.constexpr):
    """(scale along axis k with the smoothing filter, ratio of the scale without it to that)."""
    s = tl.exp(column(rows, at, mask, LOG_SCALE + k, REAL))
    ratio = s * 0.0 + 1.0
    if SMOOTH:
        larger, smaller = tl.maximum(s, width), tl.minimum(s, width)
        quotient = smaller / larger
        widened = larger * tl.sqrt(1.0 + quotient * quotient)
        ratio = s / widened
        s = widened
    return s, ratio


@inner
def axis_x(cam, w, x, y, z, REAL: tl.constexpr):
    """A splat's first axis in camera axes: the first column of W R(q)."""
    return turned(
        cam, 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y), REAL
    )


@inner
def axis_y(cam, w, x, y, z, REAL: tl.constexpr):
    return turned(
        cam, 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x), REAL
    )


@inner
def axis_z(cam, w, x, y, z, REAL: tl.constexpr):
    return turned(
        cam, 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y), REAL
    )


@inner
def cross(a0, a1, a2, b0, b1, b2):
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@inner
def direction(cam, rows, at, mask, REAL: tl.constexpr):
    """(unit x, y, z, distance) from the camera to a splat."""
    x = column(rows, at, mask, MEAN, REAL) - number(cam, CAMERA_CENTRE, REAL)
    y = column(rows, at, mask, MEAN + 1, REAL) - number(cam, CAMERA_CENTRE + 1, REAL)
    z = column(rows, at, mask, MEAN + 2, REAL) - number(cam, CAMERA_CENTRE + 2, REAL)
    distance = tl.sqrt(x * x + y * y + z * z)
    return x / distance, y / distance, z / distance, distance


@inner
def basis(K: tl.constexpr, x, y, z):
    """Real spherical harmonic number K of a unit direction."""
    xx, yy, zz = x * x, y * y, z * z
    value = x * 0.0 + K0
    if K == 1:
        value = -K1 * y
    if K == 2:
        value = K1 * z
    if K == 3:
        value = -K1 * x
    if K == 4:
        value = K20 * x * y
    if K == 5:
        value = -K20 * y * z
    if K == 6:
        value = K21 * (2.0 * zz - xx - yy)
    if K == 7:
        value = -K20 * x * z
    if K == 8:
        value = K22 * (xx - yy)
    if K == 9:
        value = -K30 * y * (3.0 * xx - yy)
    if K == 10:
        value = K31 * x * y * z
    if K == 11:
        value = -K32 * y * (4.0 * zz - xx - yy)
    if K == 12:
        value = K33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    if K == 13:
        value = -K32 * x * (4.0 * zz - xx - yy)
    if K == 14:
        value = K34 * z * (xx - yy)
    if K == 15:
        value = -K30 * x * (xx - 3.0 * yy)
    return value


@inner
def basis_slope(K: tl.constexpr, x, y, z):
    """Gradient of `basis` with respect to the direction before its normalisation."""
    xx, yy, zz, none = x * x, y * y, z * z, x * 0.0
    a, b, c = none, none, none
    if K == 1:
        b = none - K1
    if K == 2:
        c = none + K1
    if K == 3:
        a = none - K1
    if K == 4:
        a, b = K20 * y, K20 * x
    if K == 5:
        b, c = -K20 * z, -K20 * y
    if K == 6:
        a, b, c = -2.0 * K21 * x, -2.0 * K21 * y, 4.0 * K21 * z
    if K == 7:
        a, c = -K20 * z, -K20 * x
    if K == 8:
        a, b = 2.0 * K22 * x, -2.0 * K22 * y
    if K == 9:
        a, b = -6.0 * K30 * x * y, -3.0 * K30 * (xx - yy)
    if K == 10:
        a, b, c = K31 * y * z, K31 * x * z, K31 * x * y
    if K == 11:
        a, b, c = 2.0 * K32 * x * y, -K32 * (4.0 * zz - xx - 3.0 * yy), -8.0 * K32 * y * z
    if K == 12:
        a, b, c = -6.0 * K33 * x * z, -6.0 * K33 * y * z, 3.0 * K33 * (2.0 * zz - xx - yy)
    if K == 13:
        a, b, c = -K32 * (4.0 * zz - 3.0 * xx - yy), 2.0 * K32 * x * y, -8.0 * K32 * x * z
    if K == 14:
        a, b, c = 2.0 * K34 * x * z, -2.0 * K34 * y * z, K34 * (xx - yy)
    if K == 15:
        a, b = -3.0 * K30 * (xx - yy), 6.0 * K30 * x * y
    return a, b, c
