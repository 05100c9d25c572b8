"""0.8 L1 + 0.2 (1 - SSIM) and its gradient, in one pass over the rows of a picture.

SSIM as Wang et al. 2004 (Gaussian window 11x11, sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1),
per channel, averaged over pixels and channels. Outside the image both images have the
target's mean, which is subtracted first.

All statistics are computed from the image x and the difference d = x - y. Squares are taken of
offsets from the centre of the window: within a row from its centre pixel, and between rows of their
means from the centre row's. E[x^2] - E[x]^2 is not accurate enough in float32: in an image half
light, half dark the squares are 0.2 and the variance 1e-4, and nearly equal images differ by less
than the rounding errors.

A strip of rows passes through two ring buffers of 11 filtered rows each, so that the working set
stays in the cache and no map of the size of the image is stored. Rows of flat arrays are given by
their first index and are not sliced, because a slice has a reference count that all threads update.
"""

from __future__ import annotations

import math

import numpy as np

from stages.raster.kernels.simd import (
    kernel,
    splat16,
    take_ticket,
    vabs,
    vfma,
    vfnma,
    vgt,
    vload,
    vselect,
    vstore,
    vsum,
)

RADIUS = 5
TAPS = 2 * RADIUS + 1
STRIP = 108  # rows of a ticket, about; each also filters 2 RADIUS rows on either side
PAD = 16  # floats before a row's first pixel, so that taps to its left read zeros
_F = np.float32
C1, C2 = _F(0.01**2), _F(0.03**2)
_GAUSS = [math.exp(-((k - RADIUS) ** 2) / (2 * 1.5**2)) for k in range(TAPS)]
WINDOW = np.array([g / sum(_GAUSS) for g in _GAUSS], np.float32)


# Filtered maps: mean of x, mean of d, variances of x and y added, variance of d.
MAPS = 4
SLOPES = 3  # derivatives, as the gradient takes them together: F0 + x F1 - d F2


@kernel
def strip_count(height):
    """Number of strips of about STRIP rows in an image."""
    return max(1, (height + STRIP // 2) // STRIP)


@kernel
def padded_row(width):
    """Length of a row with its borders: an odd number of vectors.

    The kernels read as many as 44 rows side by side. At 480 pixels an even number of vectors put
    all of them in the same few sets of the cache, and the loss took 1.8 times as long.
    """
    vectors = (2 * PAD + width + 15) // 16
    return 16 * (vectors + 1 - vectors % 2)


@kernel
def _load_row(image, target, scale, channel, y, mean, xs, ds, at):
    """Row y of the image, less the mean, into xs[at + PAD :]; the image less `scale` x the target
    into ds. Zero outside the image."""
    height, width = target.shape[1], target.shape[2]
    whole = width // 16 * 16
    start, level = (channel * height + y) * width, splat16(mean)
    if y < 0 or y >= height:
        for x in range(at + PAD, at + PAD + width):
            xs[x], ds[x] = _F(0.0), _F(0.0)
        return
    for x in range(0, whole, 16):
        value = vload(image, start + x)
        vstore(xs, at + PAD + x, value - level)
        vstore(ds, at + PAD + x, value - vload(target, start + x) * splat16(scale))
    for x in range(whole, width):
        value = image[channel, y, x]
        xs[at + PAD + x] = value - mean
        ds[at + PAD + x] = value - _F(target[channel, y, x]) * scale


@kernel
def _filter_pictures(xs, ds, at, padded, out, out_at):
    """The four maps of one padded row, over each pixel's horizontal window."""
    zero = splat16(_F(0.0))
    for x in range(PAD, padded - PAD, 16):
        middle = at + x
        x_0, d_0 = vload(xs, middle), vload(ds, middle)
        m_x, m_d, both, other = zero, zero, zero, zero
        for k in range(1, RADIUS + 1):
            weight = splat16(WINDOW[RADIUS + k])
            x_a, x_b = vload(xs, middle - k) - x_0, vload(xs, middle + k) - x_0
            d_a, d_b = vload(ds, middle - k) - d_0, vload(ds, middle + k) - d_0
            y_a, y_b = x_a - d_a, x_b - d_b
            m_x, m_d = vfma(weight, x_a + x_b, m_x), vfma(weight, d_a + d_b, m_d)
            square = vfma(x_a, x_a, vfma(x_b, x_b, vfma(y_a, y_a, y_b * y_b)))
            both = vfma(weight, square, both)
            other = vfma(weight, vfma(d_a, d_a, d_b * d_b), other)
        m_y = m_x - m_d
        vstore(out, out_at + x, x_0 + m_x)
        vstore(out, out_at + padded + x, d_0 + m_d)
        vstore(out, out_at + 2 * padded + x, vfnma(m_x, m_x, vfnma(m_y, m_y, both)))
        vstore(out, out_at + 3 * padded + x, vfnma(m_d, m_d, other))


@kernel
def _window(ring, starts, padded, at):
    """The four maps at offset `at`, over the whole window, from 11 rows of `_filter_pictures`:
    variances within rows and between the rows' means."""
    middle = starts[RADIUS] + at
    x_0, d_0 = vload(ring, middle), vload(ring, padded + middle)
    weight = splat16(WINDOW[RADIUS])
    both = weight * vload(ring, 2 * padded + middle)
    other = weight * vload(ring, 3 * padded + middle)
    m_x, m_d = splat16(_F(0.0)), splat16(_F(0.0))
    for k in range(TAPS):
        if k != RADIUS:
            row, weight = starts[k] + at, splat16(WINDOW[k])
            x, d = vload(ring, row) - x_0, vload(ring, padded + row) - d_0
            y = x - d
            m_x, m_d = vfma(weight, x, m_x), vfma(weight, d, m_d)
            square = vfma(x, x, vfma(y, y, vload(ring, 2 * padded + row)))
            both = vfma(weight, square, both)
            other = vfma(weight, vfma(d, d, vload(ring, 3 * padded + row)), other)
    m_y = m_x - m_d
    both = vfnma(m_x, m_x, vfnma(m_y, m_y, both))
    return x_0 + m_x, d_0 + m_d, both, vfnma(m_d, m_d, other)


@kernel
def _filter_row(row, at, padded, out, out_at):
    """Horizontal window sums of one padded row."""
    for x in range(PAD, padded - PAD, 16):
        middle = at + x
        total = splat16(WINDOW[RADIUS]) * vload(row, middle)
        for k in range(1, RADIUS + 1):
            pair = vload(row, middle - k) + vload(row, middle + k)
            total = vfma(splat16(WINDOW[RADIUS + k]), pair, total)
        vstore(out, out_at + x, total)


@kernel
def _column_sum(ring, at, starts):
    """Vertical window sum at offset `at` of 11 rows of a ring that begin at starts[0..10]."""
    total = splat16(WINDOW[0]) * vload(ring, starts[0] + at)
    for k in range(1, TAPS):
        total = vfma(splat16(WINDOW[k]), vload(ring, starts[k] + at), total)
    return total


@kernel
def _ring_starts(newest, row_size, starts):
    """Where the 11 rows of a ring begin whose newest is row number `newest`, oldest first."""
    for k in range(TAPS):
        starts[k] = (newest - 2 * RADIUS + k) % TAPS * row_size


@kernel
def _similarity_row(ring, starts, padded, mean, width, out):
    """SSIM of one row, c d / (a b); its derivatives into out[: 3 padded]. Returns the row's sum.

    With V, C the derivatives by the variance of x and by the covariance, a gradient adds up
    2 V (x - mean) + C (y - mean) over windows. V is nearly -C / 2 where pictures are alike, so it
    is written as (2 V + C) (x - mean) - C (d - mean), and 2 V + C by the variance of d.
    """
    one, two, mean_v = splat16(_F(1.0)), splat16(_F(2.0)), splat16(mean)
    c1, c2 = splat16(C1), splat16(C2)
    total = 0.0
    for at in range(PAD, PAD + width, 16):
        m_x, m_d, both, other = _window(ring, starts, padded, at)
        full_x = m_x + mean_v
        c = vfma(two * full_x, full_x - m_d, c1)
        a = vfma(m_d, m_d, c)
        b = both + c2
        d = b - other
        inverse = one / (a * b)
        score = c * d * inverse
        by_cov = two * c * inverse
        by_both = by_cov * other * a * inverse  # 1 / b is a / (a b)
        by_mean = two * d * inverse * m_d * (full_x * m_d * b * inverse - one)
        vstore(out, at, by_mean - m_x * by_both + m_d * by_cov)
        vstore(out, padded + at, by_both)
        vstore(out, 2 * padded + at, by_cov)
        if at + 16 <= PAD + width:
            total += vsum(score)
        else:
            vstore(out, 3 * padded + at, score)
            for x in range(at, PAD + width):
                total += out[3 * padded + x]
    for which in range(SLOPES):
        for x in range(PAD + width, padded):
            out[which * padded + x] = _F(0.0)
    return total


@kernel
def _gradient_row(ring, starts, padded, xs, ds, own, weight, scratch, v_image, channel, y):
    """Row y of v_image; returns the row's sum of |x - y|. own: where the row begins in xs, ds."""
    height, width = v_image.shape[1], v_image.shape[2]
    zero = splat16(_F(0.0))
    absolute, similar = splat16(_F((1.0 - weight) / 3.0)), splat16(_F(-weight / 3.0))
    total = zero
    to = (channel * height + y) * width
    for x in range(0, width, 16):
        at = PAD + x
        difference = vload(ds, own + at)
        alone = _column_sum(ring, at, starts)
        by_x = vload(xs, own + at) * _column_sum(ring, padded + at, starts)
        by_d = difference * _column_sum(ring, 2 * padded + at, starts)
        gradient = similar * (alone + by_x - by_d)
        sign = vselect(
            vgt(difference, zero),
            absolute,
            vselect(vgt(zero, difference), zero - absolute, zero),
        )
        total = total + vabs(difference)  # outside the image both are zero
        if x + 16 <= width:
            vstore(v_image, to + x, gradient + sign)
        else:
            spare = SLOPES * padded  # the borders before it stay zero
            vstore(scratch, spare, gradient + sign)
            for k in range(width - x):
                v_image[channel, y, x + k] = scratch[spare + k]
    return vsum(total)


@kernel
def _filter_picture_row(image, target, scale, channel, y, mean, padded, xs, ds, own, ring, to):
    """Row y of both pictures into xs, ds and its four filtered maps into the ring."""
    _load_row(image, target, scale, channel, y, mean, xs, ds, own)
    _filter_pictures(xs, ds, own, padded, ring, to)


@kernel
def loss_strips(ticket, image, target, scale, means, weight, v_image, sums):
    """Gradient of H x W x loss into v_image [3, H, W]; sums [tickets, 2]: L1 and SSIM, per strip.

    image [>= 3, H, W] float32; target [3, H, W] float32 or bytes, in units of `scale`; means [3] of
    the target (or near them); weight of the SSIM part. A ticket is a strip of one channel; sums are
    added up in order by the caller.
    """
    height, width = target.shape[1], target.shape[2]
    strips = strip_count(height)
    strip = (height + strips - 1) // strips
    padded = padded_row(width)
    xs, ds = np.zeros(TAPS * padded, np.float32), np.zeros(TAPS * padded, np.float32)
    maps = np.zeros(TAPS * MAPS * padded, np.float32)
    slopes = np.zeros(TAPS * SLOPES * padded, np.float32)
    scratch = np.zeros(4 * padded, np.float32)
    starts = np.zeros(TAPS, np.int64)
    while True:
        number = take_ticket(ticket)
        if number >= 3 * strips:
            break
        channel, top = number // strips, (number % strips) * strip
        bottom = min(top + strip, height)
        mean = means[channel]
        l1, ssim = 0.0, 0.0
        for y in range(top - 2 * RADIUS, bottom + 2 * RADIUS):
            slot = y % TAPS
            own, to = slot * padded, slot * MAPS * padded
            _filter_picture_row(
                image, target, scale, channel, y, mean, padded, xs, ds, own, maps, to
            )
            middle = y - RADIUS
            if middle < top - RADIUS:
                continue
            to = middle % TAPS * SLOPES * padded
            if 0 <= middle < height:
                _ring_starts(y, MAPS * padded, starts)
                row_sum = _similarity_row(maps, starts, padded, mean, width, scratch)
                if top <= middle < bottom:
                    ssim += row_sum
                for which in range(SLOPES):
                    _filter_row(scratch, which * padded, padded, slopes, to + which * padded)
            else:
                for x in range(SLOPES * padded):
                    slopes[to + x] = _F(0.0)
            out = middle - RADIUS
            if out >= top:
                _ring_starts(middle, SLOPES * padded, starts)
                own = out % TAPS * padded
                l1 += _gradient_row(
                    slopes, starts, padded, xs, ds, own, weight, scratch, v_image, channel, out
                )
        sums[number, 0], sums[number, 1] = l1, ssim
