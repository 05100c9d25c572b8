"""0.8 L1 + 0.2 (1 - SSIM) and its gradient, in one pass over the rows of a picture.

SSIM as Wang et al. 2004 (Gaussian window 11x11, sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1),
per channel, averaged over pixels and channels. The target's mean is subtracted from both pictures
first: variances as E[x^2] - E[x]^2 then lose nothing in float32, however bright the pictures.
Beyond the rim both pictures are taken to have that mean.

A band of rows streams through two rings of 11 filtered rows each, so that the working set stays in
the cache and no map of the size of the picture is ever made. SSIM needs four filtered maps: x, y,
x^2 + y^2 and x y. Rows of flat arrays are named by where they begin, never sliced: a slice counts
references, and threads would fight over the counter.
"""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.simd import (
    kernel,
    splat16,
    take_ticket,
    vabs,
    vfma,
    vgt,
    vload,
    vload_levels,
    vselect,
    vstore,
    vsum,
)

RADIUS = 5
TAPS = 2 * RADIUS + 1
BAND = 108  # rows a ticket, about; each also filters 2 RADIUS rows on either side
PAD = 16  # floats before a row's first pixel, so that taps to its left read zeros
_F = np.float32
C1, C2 = _F(0.01**2), _F(0.03**2)
_GAUSS = [math.exp(-((k - RADIUS) ** 2) / (2 * 1.5**2)) for k in range(TAPS)]
WINDOW = np.array([g / sum(_GAUSS) for g in _GAUSS], np.float32)


MAPS, SLOPES = 4, 3  # filtered maps; derivatives: by mean, by variance, by covariance


@kernel
def band_count(height):
    """Into how many bands of about BAND rows a picture is cut."""
    return max(1, (height + BAND // 2) // BAND)


@kernel
def _load_row(picture, scale, channel, y, mean, row, at):
    """Row y, times `scale`, less the mean into row[at + PAD :]; zero beyond the rim."""
    height, width = picture.shape[1], picture.shape[2]
    whole = width // 16 * 16
    start, level = (channel * height + y) * width, splat16(mean)
    if y < 0 or y >= height:
        for x in range(width):
            row[at + PAD + x] = _F(0.0)
        return
    for x in range(0, whole, 16):
        value = vload_levels(picture, start + x) * splat16(scale)
        vstore(row, at + PAD + x, value - level)
    for x in range(whole, width):
        row[at + PAD + x] = _F(picture[channel, y, x]) * scale - mean


@kernel
def _multiply_rows(xs, x_at, ys, y_at, padded, products):
    """x^2 + y^2 and x y of a row into products[: 2 padded]."""
    for at in range(0, padded, 16):
        x, y = vload(xs, x_at + at), vload(ys, y_at + at)
        vstore(products, at, vfma(x, x, y * y))
        vstore(products, padded + at, x * y)


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
    """SSIM of one row; its derivatives by mean, variance and covariance into out[: 3 padded].

    Returns the row's sum. Derivatives are those of the filtered maps of x, x^2 and xy.
    """
    two, mean_v = splat16(_F(2.0)), splat16(mean)
    c1, c2 = splat16(C1), splat16(C2)
    total = 0.0
    for at in range(PAD, PAD + width, 16):
        m_x, m_y = _column_sum(ring, at, starts), _column_sum(ring, padded + at, starts)
        squares = _column_sum(ring, 2 * padded + at, starts)
        cov = _column_sum(ring, 3 * padded + at, starts) - m_x * m_y
        full_x, full_y = m_x + mean_v, m_y + mean_v
        a = full_x * full_x + full_y * full_y + c1
        b = (squares - m_x * m_x - m_y * m_y) + c2
        c = two * full_x * full_y + c1
        d = two * cov + c2
        inverse = splat16(_F(1.0)) / (a * b)
        score = c * d * inverse
        by_variance = splat16(_F(0.0)) - score * a * inverse
        by_cov = two * c * inverse
        by_mean = two * (full_y * d - full_x * score * b) * inverse
        by_mean = by_mean - two * m_x * by_variance - m_y * by_cov
        vstore(out, at, by_mean)
        vstore(out, padded + at, by_variance)
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
def _gradient_row(ring, starts, padded, xs, ys, own, weight, scratch, v_image, channel, y):
    """Row y of v_image; returns the row's sum of |x - y|. own: where the row begins in xs, ys."""
    height, width = v_image.shape[1], v_image.shape[2]
    zero, two = splat16(_F(0.0)), splat16(_F(2.0))
    absolute, similar = splat16(_F((1.0 - weight) / 3.0)), splat16(_F(-weight / 3.0))
    total = zero
    to = (channel * height + y) * width
    for x in range(0, width, 16):
        at = PAD + x
        x_v, y_v = vload(xs, own + at), vload(ys, own + at)
        by_mean = _column_sum(ring, at, starts)
        by_variance = _column_sum(ring, padded + at, starts)
        by_cov = _column_sum(ring, 2 * padded + at, starts)
        gradient = similar * (by_mean + two * x_v * by_variance + y_v * by_cov)
        difference = x_v - y_v
        sign = vselect(
            vgt(difference, zero),
            absolute,
            vselect(vgt(zero, difference), zero - absolute, zero),
        )
        total = total + vabs(difference)  # beyond the rim both are zero
        if x + 16 <= width:
            vstore(v_image, to + x, gradient + sign)
        else:
            vstore(scratch, 0, gradient + sign)
            for k in range(width - x):
                v_image[channel, y, x + k] = scratch[k]
    return vsum(total)


@kernel
def _filter_picture_row(
    image, target, scale, channel, y, mean, padded, xs, ys, own, scratch, ring, to
):
    """Row y of both pictures into xs, ys and its four filtered maps into the ring."""
    _load_row(image, _F(1.0), channel, y, mean, xs, own)
    _load_row(target, scale, channel, y, mean, ys, own)
    _multiply_rows(xs, own, ys, own, padded, scratch)
    _filter_row(xs, own, padded, ring, to)
    _filter_row(ys, own, padded, ring, to + padded)
    _filter_row(scratch, 0, padded, ring, to + 2 * padded)
    _filter_row(scratch, padded, padded, ring, to + 3 * padded)


@kernel
def loss_bands(ticket, image, target, scale, means, weight, v_image, sums):
    """Gradient of H x W x loss into v_image [3, H, W]; sums [tickets, 2]: L1 and SSIM, per band.

    image [>= 3, H, W] float32; target [3, H, W] float32 or bytes, in units of `scale`; means [3] of
    the target (or near them); weight of the SSIM part. A ticket is a band of one channel; sums are
    added up in order by the caller.
    """
    height, width = target.shape[1], target.shape[2]
    bands = band_count(height)
    band = (height + bands - 1) // bands
    padded = 2 * PAD + (width + 15) // 16 * 16
    xs, ys = np.zeros(TAPS * padded, np.float32), np.zeros(TAPS * padded, np.float32)
    maps = np.zeros(TAPS * MAPS * padded, np.float32)
    slopes = np.zeros(TAPS * SLOPES * padded, np.float32)
    scratch = np.zeros(4 * padded, np.float32)
    starts = np.zeros(TAPS, np.int64)
    while True:
        number = take_ticket(ticket)
        if number >= 3 * bands:
            break
        channel, top = number // bands, (number % bands) * band
        bottom = min(top + band, height)
        mean = means[channel]
        l1, ssim = 0.0, 0.0
        for y in range(top - 2 * RADIUS, bottom + 2 * RADIUS):
            slot = y % TAPS
            own, to = slot * padded, slot * MAPS * padded
            _filter_picture_row(
                image, target, scale, channel, y, mean, padded, xs, ys, own, scratch, maps, to
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
                    slopes, starts, padded, xs, ys, own, weight, scratch, v_image, channel, out
                )
        sums[number, 0], sums[number, 1] = l1, ssim
