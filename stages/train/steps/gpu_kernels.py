"""The loss and the optimiser on the GPU. Definitions as in `loss_kernels` and `optimiser`.

L1 + SSIM takes four passes over the image: along rows and across them for the statistics of both
images, and again for the derivatives that the gradient sums. A pass reads 11 neighbours from the
cache.
"""

from __future__ import annotations

import triton
import triton.language as tl

from stages.raster import definition
from stages.raster.definition import used_columns
from stages.raster.gpu.inner import inner, sum_of
from stages.train import gauss_newton, optimiser
from stages.train.steps import loss_kernels

RADIUS = tl.constexpr(loss_kernels.RADIUS)
WINDOW = tl.constexpr(tuple(float(w) for w in loss_kernels.WINDOW))
C1, C2 = tl.constexpr(float(loss_kernels.C1)), tl.constexpr(float(loss_kernels.C2))
BETA1, BETA2 = tl.constexpr(optimiser.BETA1), tl.constexpr(optimiser.BETA2)
REST1, REST2 = tl.constexpr(1.0 - optimiser.BETA1), tl.constexpr(1.0 - optimiser.BETA2)
EPSILON = tl.constexpr(optimiser.EPSILON)
CURVATURE_DECAY = tl.constexpr(gauss_newton.CURVATURE_DECAY)
REST_CURVATURE = tl.constexpr(1.0 - gauss_newton.CURVATURE_DECAY)
LARGEST = tl.constexpr(optimiser.LARGEST_GRADIENT)
COUNTS = tl.constexpr(optimiser.STEP_COUNTS)
LAST_CORRECTION = tl.constexpr(len(optimiser.bias_corrections()) - 1)
ROTATION, LOG_SCALE = tl.constexpr(definition.ROTATION), tl.constexpr(definition.LOG_SCALE)
OPACITY, SH = tl.constexpr(definition.OPACITY), tl.constexpr(definition.SH)
SH_REST = tl.constexpr(definition.SH_REST)
SIZE = ("width", "height")  # one compiled kernel for all
DEGREE_2, DEGREE_3 = tl.constexpr(used_columns(4)), tl.constexpr(used_columns(9))


@inner
def place(width, height, BLOCK: tl.constexpr):
    """(offset in the three planes, x, y, whether there is such a pixel) of this program's lanes."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return at, at % width, at // width % height, at < 3 * width * height


@inner
def pictures(image, target, means, unit, at, mask, width, height):
    """(picture less the target's mean, picture less target) at offsets; 0 where masked. unit: the
    value of 1 in the target."""
    value = tl.load(image + at, mask=mask, other=0.0)
    level = tl.load(means + at // (width * height), mask=mask, other=0.0)
    wanted = tl.load(target + at, mask=mask, other=0).to(tl.float32) * unit
    return tl.where(mask, value - level, 0.0), tl.where(mask, value - wanted, 0.0)


@triton.jit(do_not_specialize=SIZE)
def rows_kernel(image, target, means, unit, maps, width, height, BLOCK: tl.constexpr):
    """maps [4, 3, H, W]: means of the picture and of the difference over a row's window, both
    pictures' variances added, the difference's."""
    at, x, _, mask = place(width, height, BLOCK)
    x_0, d_0 = pictures(image, target, means, unit, at, mask, width, height)
    m_x, m_d, both, other = x_0 * 0.0, x_0 * 0.0, x_0 * 0.0, x_0 * 0.0
    for k in tl.static_range(11):
        shift = k - RADIUS
        there = mask & (x + shift >= 0) & (x + shift < width)
        x_k, d_k = pictures(image, target, means, unit, at + shift, there, width, height)
        x_k, d_k = x_k - x_0, d_k - d_0
        m_x += WINDOW[k] * x_k
        m_d += WINDOW[k] * d_k
        both += WINDOW[k] * (x_k * x_k + (x_k - d_k) * (x_k - d_k))
        other += WINDOW[k] * d_k * d_k
    m_y, plane = m_x - m_d, 3 * width * height
    tl.store(maps + at, x_0 + m_x, mask=mask)
    tl.store(maps + plane + at, d_0 + m_d, mask=mask)
    tl.store(maps + 2 * plane + at, both - m_x * m_x - m_y * m_y, mask=mask)
    tl.store(maps + 3 * plane + at, other - m_d * m_d, mask=mask)


@triton.jit(do_not_specialize=SIZE)
def similarity_kernel(maps, means, slopes, sums, width, height, BLOCK: tl.constexpr):
    """slopes [3, 3, H, W]: see `loss_kernels._similarity_row`. sums [programs]: of SSIM."""
    at, _, y, mask = place(width, height, BLOCK)
    plane = 3 * width * height
    x_0 = tl.load(maps + at, mask=mask, other=0.0)
    d_0 = tl.load(maps + plane + at, mask=mask, other=0.0)
    m_x, m_d, both, other = x_0 * 0.0, x_0 * 0.0, x_0 * 0.0, x_0 * 0.0
    for k in tl.static_range(11):
        shift = k - RADIUS
        row = at + shift * width
        there = mask & (y + shift >= 0) & (y + shift < height)
        x_k = tl.load(maps + row, mask=there, other=0.0) - x_0
        d_k = tl.load(maps + plane + row, mask=there, other=0.0) - d_0
        m_x += WINDOW[k] * x_k
        m_d += WINDOW[k] * d_k
        square = x_k * x_k + (x_k - d_k) * (x_k - d_k)
        both += WINDOW[k] * (square + tl.load(maps + 2 * plane + row, mask=there, other=0.0))
        spread = tl.load(maps + 3 * plane + row, mask=there, other=0.0)
        other += WINDOW[k] * (d_k * d_k + spread)
    m_y = m_x - m_d
    both, other = both - m_x * m_x - m_y * m_y, other - m_d * m_d
    m_x, m_d = x_0 + m_x, d_0 + m_d
    full_x = m_x + tl.load(means + at // (width * height), mask=mask, other=0.0)
    c = 2.0 * full_x * (full_x - m_d) + C1
    a, b = m_d * m_d + c, both + C2
    d, inverse = b - other, 1.0 / (a * b)
    by_cov = 2.0 * c * inverse
    by_both = by_cov * other * a * inverse
    by_mean = 2.0 * d * inverse * m_d * (full_x * m_d * b * inverse - 1.0)
    tl.store(slopes + at, by_mean - m_x * by_both + m_d * by_cov, mask=mask)
    tl.store(slopes + plane + at, by_both, mask=mask)
    tl.store(slopes + 2 * plane + at, by_cov, mask=mask)
    tl.store(sums + tl.program_id(0), sum_of(tl.where(mask, c * d * inverse, 0.0), 0))


@triton.jit(do_not_specialize=SIZE)
def slope_rows_kernel(slopes, filtered, width, height, BLOCK: tl.constexpr):
    """filtered [3, 3, H, W]: the slopes over a row's window."""
    at, x, _, mask = place(width, height, BLOCK)
    plane = 3 * width * height
    for which in tl.static_range(3):
        total = (at * 0).to(tl.float32)
        for k in tl.static_range(11):
            shift = k - RADIUS
            there = mask & (x + shift >= 0) & (x + shift < width)
            total += WINDOW[k] * tl.load(slopes + which * plane + at + shift, mask=there, other=0.0)
        tl.store(filtered + which * plane + at, total, mask=mask)


@triton.jit(do_not_specialize=SIZE)
def loss_gradient_kernel(
    image, target, means, unit, filtered, v_image, sums, weight, width, height, BLOCK: tl.constexpr
):
    """v_image [3, H, W]: gradient of H x W x loss. sums [programs]: of |difference|."""
    at, _, y, mask = place(width, height, BLOCK)
    plane = 3 * width * height
    x_0, d_0 = pictures(image, target, means, unit, at, mask, width, height)
    alone, by_x, by_d = x_0 * 0.0, x_0 * 0.0, x_0 * 0.0
    for k in tl.static_range(11):
        row = at + (k - RADIUS) * width
        there = mask & (y + (k - RADIUS) >= 0) & (y + (k - RADIUS) < height)
        alone += WINDOW[k] * tl.load(filtered + row, mask=there, other=0.0)
        by_x += WINDOW[k] * tl.load(filtered + plane + row, mask=there, other=0.0)
        by_d += WINDOW[k] * tl.load(filtered + 2 * plane + row, mask=there, other=0.0)
    sign = (d_0 > 0.0).to(tl.float32) - (d_0 < 0.0).to(tl.float32)
    similar = (alone + x_0 * by_x - d_0 * by_d) * (-weight / 3.0)
    tl.store(v_image + at, similar + sign * ((1.0 - weight) / 3.0), mask=mask)
    tl.store(sums + tl.program_id(0), sum_of(tl.abs(d_0), 0))


@inner
def group_of(k):
    """By which count of steps a column goes: see `optimiser.COLUMN_COUNTS`."""
    group = (k >= SH_REST).to(tl.int32) * 2 + (k >= DEGREE_2).to(tl.int32)
    return group + (k >= DEGREE_3).to(tl.int32) + (k == OPACITY).to(tl.int32)


@triton.jit(
    do_not_specialize=["room", "n", "used", "active"],
    do_not_specialize_on_alignment=["total"],
)
def move_kernel(
    rows,
    moment1,
    moment2,
    steps,
    gradients,
    means2d,
    keys,
    gradient_sum,
    gradient_count,
    distances,
    corrections,
    total,
    room,
    n,
    used,
    active,
    rate_means,
    rate_rotation,
    rate_scale,
    rate_opacity,
    rate_dc,
    rate_rest,
    ndc_x,
    ndc_y,
    extent,
    damping,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    GAUSS_NEWTON: tl.constexpr,
):
    """Move the visible splats: see `move_splats` in `optimiser`. rows, moments and gradients [n,
    COLUMNS], of which `used` columns and the first `active` counts take part. WIDTH: a power of two
    that holds a row. GAUSS_NEWTON: whether to move by the curvature in moment2, with `damping`.

    Nothing moves where the lists held more entries (total) than there was room for.
    """
    i, k, at, moved, there, g = usable(gradients, keys, total, room, n, used, COLUMNS, WIDTH, BLOCK)
    group = group_of(k)
    # every lane reads the counts before any writes one
    t = tl.load(steps + i[:, None] * COUNTS + group[None, :], mask=there, other=0) + 1
    tl.debug_barrier()
    first = there & (leads(k) & (group < active))[None, :]
    tl.store(steps + i[:, None] * COUNTS + group[None, :], t, mask=first)
    t = tl.minimum(tl.maximum(t, 1), LAST_CORRECTION)
    m = BETA1 * tl.load(moment1 + at, mask=there, other=0.0) + REST1 * g
    tl.store(moment1 + at, m, mask=there)
    m = m * tl.load(corrections + 2 * t, mask=there, other=0.0)
    v = tl.load(moment2 + at, mask=there, other=0.0)
    rate = rate_of(k, rate_means, rate_rotation, rate_scale, rate_opacity, rate_dc, rate_rest)
    distance = tl.load(distances + i, mask=moved, other=1.0)
    rate = tl.where((k < ROTATION)[None, :], rate[None, :] * distance[:, None], rate[None, :])
    if GAUSS_NEWTON:
        unit = tl.where(k < ROTATION, 1.0 / extent, 1.0)[None, :]
        share = m / (damping * v * rate * unit + EPSILON)
        share = tl.minimum(tl.maximum(share, -1.0), 1.0)
        step = tl.where(v > 0.0, rate * share, 0.0)
    else:
        v = BETA2 * v + REST2 * g * g
        tl.store(moment2 + at, v, mask=there)
        v = v * tl.load(corrections + 2 * t + 1, mask=there, other=0.0)
        step = rate * m / (tl.sqrt(v) + EPSILON)
    value = tl.load(rows + at, mask=there, other=0.0)
    tl.store(rows + at, value - step, mask=there)
    accumulate(means2d, gradient_sum, gradient_count, i, moved, ndc_x, ndc_y)


@triton.jit(do_not_specialize=["room", "n", "used"], do_not_specialize_on_alignment=["total"])
def average_squares_kernel(
    curvature,
    derivatives,
    keys,
    total,
    room,
    n,
    used,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add the squares of derivatives to the averages of the visible splats: see
    `optimiser.average_squares`; arguments as for `move_kernel`."""
    _, _, at, _, there, d = usable(derivatives, keys, total, room, n, used, COLUMNS, WIDTH, BLOCK)
    h = tl.load(curvature + at, mask=there, other=0.0)
    h = tl.where(h > 0.0, CURVATURE_DECAY * h + REST_CURVATURE * d * d, d * d)
    tl.store(curvature + at, h, mask=there)


@inner
def usable(
    gradients,
    keys,
    total,
    room,
    n,
    used,
    COLUMNS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """(rows [BLOCK], columns [WIDTH], offsets [BLOCK, WIDTH], whether a row is visible and its
    gradients are neither larger than LARGEST nor broken, the same for its used columns, the
    gradients) of this program."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    k = tl.arange(0, WIDTH)
    moved = (i < n) & (tl.load(total) <= room)
    moved = moved & (tl.load(keys + i, mask=moved, other=float("inf")) < float("inf"))
    there = moved[:, None] & (k < used)[None, :]
    at = i[:, None] * COLUMNS + k[None, :]
    g = tl.load(gradients + at, mask=there, other=0.0)
    wrong = tl.where(tl.abs(g) <= LARGEST, 0, 1)
    moved = moved & (sum_of(wrong, 1) == 0)
    return i, k, at, moved, there & moved[:, None], g


@inner
def leads(k):
    """Whether a column is the first that goes by its count."""
    return (k == 0) | (k == OPACITY) | (k == SH_REST) | (k == DEGREE_2) | (k == DEGREE_3)


@inner
def rate_of(k, means, rotation, scale, opacity, dc, rest):
    """The learning rate of each column."""
    rate = tl.where(k < ROTATION, means, tl.where(k < LOG_SCALE, rotation, scale))
    rate = tl.where(k < OPACITY, rate, tl.where(k < SH, opacity, rest))
    return tl.where((k >= SH) & (k < SH_REST), dc, rate)


@inner
def accumulate(means2d, gradient_sum, gradient_count, i, moved, ndc_x, ndc_y):
    """Add the norm of the gradient by the 2D position to the statistics of densification."""
    gx = tl.load(means2d + 2 * i, mask=moved, other=0.0) * ndc_x
    gy = tl.load(means2d + 2 * i + 1, mask=moved, other=0.0) * ndc_y
    total_gradient = tl.load(gradient_sum + i, mask=moved, other=0.0) + tl.sqrt(gx * gx + gy * gy)
    tl.store(gradient_sum + i, total_gradient, mask=moved)
    seen = tl.load(gradient_count + i, mask=moved, other=0) + 1
    tl.store(gradient_count + i, seen, mask=moved)
