"""0.8 L1 + 0.2 (1 - SSIM) and its gradient, in one pass over the rows of a picture.

SSIM as Wang et al. 2004 (Gaussian window 11x11, sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1),
per channel, averaged over pixels and channels. The target's mean is subtracted from both pictures
first: variances as E[x^2] - E[x]^2 then lose nothing in float32, however bright the pictures.
Beyond the rim both pictures are taken to have that mean.

A band of rows streams through two rings of 11 filtered rows each, so that the working set stays in
the cache and no map of the size of the picture is ever made.
"""

from __future__ import annotations

import math

import numpy as np

from stages.raster.simd import (
    kernel,
    splat16,
    take_ticket,
    vabs,
    vfma,
    vgt,
    vload,
    vselect,
    vstore,
    vsum,
)

RADIUS = 5
TAPS = 2 * RADIUS + 1
BAND = 64  # rows a ticket; each also filters 2 RADIUS rows on either side
PAD = 16  # floats before a row's first pixel, so that taps to its left read zeros
_F = np.float32
C1, C2 = _F(0.01**2), _F(0.03**2)
_GAUSS = [math.exp(-((k - RADIUS) ** 2) / (2 * 1.5**2)) for k in range(TAPS)]
WINDOW = np.array([g / sum(_GAUSS) for g in _GAUSS], np.float32)


def padded_width(width: int) -> int:
    """Floats a padded row takes: whole vectors, with room for the taps on both sides."""
    return PAD + (width + 15) // 16 * 16 + PAD


@kernel
def _load_row(picture, channel, y, mean, row):
    """Row y less the mean, zero beyond the rim."""
    height, width = picture.shape[1], picture.shape[2]
    if y < 0 or y >= height:
        row[:] = _F(0.0)
        return
    for x in range(width):
        row[PAD + x] = picture[channel, y, x] - mean


@kernel
def _filter_products(xs, ys, out):
    """Horizontal window sums of x, y, x^2, y^2, xy into out[5, :]."""
    zero = splat16(_F(0.0))
    for at in range(PAD, len(xs) - PAD, 16):
        s_x, s_y, s_xx, s_yy, s_xy = zero, zero, zero, zero, zero
        for k in range(TAPS):
            weight = splat16(WINDOW[k])
            x, y = vload(xs, at + k - RADIUS), vload(ys, at + k - RADIUS)
            wx, wy = weight * x, weight * y
            s_x, s_y = s_x + wx, s_y + wy
            s_xx, s_yy, s_xy = vfma(wx, x, s_xx), vfma(wy, y, s_yy), vfma(wx, y, s_xy)
        vstore(out[0], at, s_x)
        vstore(out[1], at, s_y)
        vstore(out[2], at, s_xx)
        vstore(out[3], at, s_yy)
        vstore(out[4], at, s_xy)


@kernel
def _column_sum(ring, which, newest, at):
    """Vertical window sum over a ring of rows whose newest row is number `newest`."""
    total = splat16(_F(0.0))
    for k in range(TAPS):
        slot = (newest - 2 * RADIUS + k) % TAPS
        total = vfma(splat16(WINDOW[k]), vload(ring[slot, which], at), total)
    return total


@kernel
def _similarity_row(ring, newest, mean, width, out):
    """SSIM of one row; its derivatives by mean, variance and covariance into out[3, :].

    Returns the row's sum. Derivatives are those of the filtered sums of x, x^2 and xy.
    """
    two, mean_v = splat16(_F(2.0)), splat16(mean)
    c1, c2 = splat16(C1), splat16(C2)
    total = 0.0
    for at in range(PAD, PAD + width, 16):
        m_x, m_y = _column_sum(ring, 0, newest, at), _column_sum(ring, 1, newest, at)
        v_x = _column_sum(ring, 2, newest, at) - m_x * m_x
        v_y = _column_sum(ring, 3, newest, at) - m_y * m_y
        cov = _column_sum(ring, 4, newest, at) - m_x * m_y
        full_x, full_y = m_x + mean_v, m_y + mean_v
        a = full_x * full_x + full_y * full_y + c1
        b = v_x + v_y + c2
        c = two * full_x * full_y + c1
        d = two * cov + c2
        inverse = splat16(_F(1.0)) / (a * b)
        score = c * d * inverse
        by_variance = splat16(_F(0.0)) - score / b
        by_cov = two * c * inverse
        by_mean = two * (full_y * d * inverse - full_x * score / a)
        by_mean = by_mean - two * m_x * by_variance - m_y * by_cov
        vstore(out[0], at, by_mean)
        vstore(out[1], at, by_variance)
        vstore(out[2], at, by_cov)
        if at + 16 <= PAD + width:
            total += vsum(score)
        else:
            vstore(out[3], at, score)
            for x in range(at, PAD + width):
                total += out[3, x]
    for x in range(PAD + width, out.shape[1]):
        out[0, x], out[1, x], out[2, x] = _F(0.0), _F(0.0), _F(0.0)
    return total


@kernel
def _filter_rows(rows, out):
    """Horizontal window sums of three rows."""
    for which in range(3):
        row, target = rows[which], out[which]
        for at in range(PAD, len(row) - PAD, 16):
            total = splat16(_F(0.0))
            for k in range(TAPS):
                total = vfma(splat16(WINDOW[k]), vload(row, at + k - RADIUS), total)
            vstore(target, at, total)


@kernel
def _gradient_row(ring, newest, xs, ys, weight, scratch, v_row):
    """v_row[W] = gradient of one row; returns the row's sum of |x - y|."""
    width = len(v_row)
    zero, two = splat16(_F(0.0)), splat16(_F(2.0))
    absolute, similar = splat16(_F((1.0 - weight) / 3.0)), splat16(_F(-weight / 3.0))
    total = zero
    for at in range(PAD, PAD + width, 16):
        x, y = vload(xs, at), vload(ys, at)
        by_mean = _column_sum(ring, 0, newest, at)
        by_variance = _column_sum(ring, 1, newest, at)
        by_cov = _column_sum(ring, 2, newest, at)
        gradient = similar * (by_mean + two * x * by_variance + y * by_cov)
        difference = x - y
        sign = vselect(
            vgt(difference, zero),
            absolute,
            vselect(vgt(zero, difference), zero - absolute, zero),
        )
        vstore(scratch, at, gradient + sign)
        total = total + vabs(difference)  # beyond the rim both are zero
    for x_at in range(width):
        v_row[x_at] = scratch[PAD + x_at]
    return vsum(total)


@kernel
def loss_bands(ticket, image, target, means, weight, v_image, sums):
    """Gradient of H x W x loss into v_image [3, H, W]; sums [tickets, 2]: L1 and SSIM, per band.

    image [>= 3, H, W], target [3, H, W] float32; means [3] of the target; weight of the SSIM part.
    A ticket is a band of one channel; sums are added up in order by the caller.
    """
    height, width = target.shape[1], target.shape[2]
    bands = (height + BAND - 1) // BAND
    padded = 2 * PAD + (width + 15) // 16 * 16
    kept = 2 * RADIUS + 1
    xs = np.zeros((kept, padded), np.float32)
    ys = np.zeros((kept, padded), np.float32)
    products = np.zeros((TAPS, 5, padded), np.float32)
    derivatives = np.zeros((TAPS, 3, padded), np.float32)
    rows = np.zeros((4, padded), np.float32)
    while True:
        number = take_ticket(ticket)
        if number >= 3 * bands:
            break
        channel, top = number // bands, (number % bands) * BAND
        bottom = min(top + BAND, height)
        l1, ssim = 0.0, 0.0
        for y in range(top - 2 * RADIUS, bottom + 2 * RADIUS):
            slot = y % kept
            _load_row(image, channel, y, means[channel], xs[slot])
            _load_row(target, channel, y, means[channel], ys[slot])
            _filter_products(xs[slot], ys[slot], products[slot])
            middle = y - RADIUS
            if middle < top - RADIUS:
                continue
            if 0 <= middle < height:
                row_sum = _similarity_row(products, y, means[channel], width, rows)
                if top <= middle < bottom:
                    ssim += row_sum
                _filter_rows(rows, derivatives[middle % TAPS])
            else:
                derivatives[middle % TAPS] = _F(0.0)
            out = middle - RADIUS
            if out >= top:
                at = out % kept
                l1 += _gradient_row(
                    derivatives,
                    middle,
                    xs[at],
                    ys[at],
                    weight,
                    rows[3],
                    v_image[channel, out],
                )
        sums[number, 0], sums[number, 1] = l1, ssim
