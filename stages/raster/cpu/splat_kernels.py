"""The kernels that run over splats: projecting, shading, and gathering gradients."""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.simd import (
    kernel,
    splat16,
    take_ticket,
    vstore,
)
from stages.kernels.simd64 import (
    LANES,
    bits8,
    dgt,
    dload,
    dmax,
    dmin,
    dselect,
    dsqrt,
    dstore,
    gather8,
    scatter8,
    spread8,
)
from stages.raster.cpu.binning import COUNT, SLOT
from stages.raster.cpu.projection import (
    GA,
    GB,
    GEOMETRY_ROW,
    GK,
    WORK_ROW,
    A,
    C,
    at,
    drawable,
    footprint,
    footprint_gradient,
    geometry_records,
    used_opacity,
)
from stages.raster.cpu.sh_kernels import sh_basis, sh_direction_gradient

OUT_OF_VIEW, VISIBLE, CULLED = 0, 1, 2
BRIGHTEST = 3.4e38  # an infinite colour would turn "none of it" into NaN
SUMS = 9  # of a splat's gradients in a tile; see `blend.entry_gradient`


@kernel
def _name_rows(rows, start, end):
    """The next eight rows from `start`; beyond `end` the last one again."""
    for lane in range(LANES):
        rows[lane] = min(start + lane, end - 1)


@kernel
def _colours_are_finite(i, sh):
    for band in range(sh.shape[1]):
        for channel in range(3):
            if not math.isfinite(sh[i, band, channel]):
                return False
    return True


@kernel
def _block_of_colours_is_finite(start, sh):
    """Whether eight rows from `start` hold finite colours only; 0 x value is 0 for those."""
    size = sh.shape[1] * 3
    nothing = spread8(0.0)
    for k in range(size):
        nothing = nothing + 0.0 * dload(sh, start * size + LANES * k)
    return bits8(dgt(1.0, nothing)) == 255


@kernel
def project_splats(
    ticket,
    chunk,
    cam,
    degree,
    means,
    quaternions,
    log_scales,
    opacity_logits,
    sh,
    smoothing,
    geometry,
    paint,
    status,
):
    """Geometry record, paint and status (0 out of view, 1 visible, 2 not drawable) of each row.

    geometry [N, 8], paint [N, 4] (colour and depth): filled for visible rows only.
    """
    n = len(means)
    w = np.empty(WORK_ROW * LANES, np.float64)
    basis = np.empty(16 * LANES, np.float64)
    rows = np.empty(LANES, np.int64)
    seen = np.empty(chunk, np.int64)
    while True:
        first = take_ticket(ticket) * chunk
        if first >= n:
            break
        last = min(first + chunk, n)
        n_seen = 0
        for start in range(first, last, LANES):
            _name_rows(rows, start, last)
            good = bits8(drawable(rows, means, quaternions, log_scales, opacity_logits))
            in_front = bits8(
                footprint(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w)
            )
            drawn = bits8(geometry_records(cam, w, rows, geometry)) & good & in_front
            whole = start + LANES <= n and _block_of_colours_is_finite(start, sh)
            for lane in range(min(LANES, last - start)):
                i = start + lane
                if not (good >> lane) & 1 or not (whole or _colours_are_finite(i, sh)):
                    status[i] = CULLED
                elif (drawn >> lane) & 1:
                    status[i] = VISIBLE
                    seen[n_seen] = i
                    n_seen += 1
                else:
                    status[i] = OUT_OF_VIEW
        for start in range(0, n_seen, LANES):
            for lane in range(LANES):
                rows[lane] = seen[min(start + lane, n_seen - 1)]
            _shade(rows, cam, degree, means, sh, basis, paint)


@kernel
def _direction(rows, cam, means):
    """(unit x, y, z, distance) from the camera to eight rows."""
    x = gather8(means, rows, 3, 0) - cam[23]
    y = gather8(means, rows, 3, 1) - cam[24]
    z = gather8(means, rows, 3, 2) - cam[25]
    distance = dsqrt(x * x + y * y + z * z)
    return x / distance, y / distance, z / distance, distance


@kernel
def _shade(rows, cam, degree, means, sh, basis, paint):
    x, y, z, _ = _direction(rows, cam, means)
    sh_basis(degree, x, y, z, basis)
    stride = 3 * sh.shape[1]
    for channel in range(3):
        value = spread8(0.5)
        for band in range((degree + 1) * (degree + 1)):
            value = value + dload(basis, LANES * band) * gather8(
                sh, rows, stride, 3 * band + channel
            )
        scatter8(paint, rows, 4, channel, dmin(dmax(value, 0.0), BRIGHTEST))
    mx, my, mz = gather8(means, rows, 3, 0), gather8(means, rows, 3, 1), gather8(means, rows, 3, 2)
    scatter8(paint, rows, 4, 3, cam[6] * mx + cam[7] * my + cam[8] * mz + cam[11])


@kernel
def _colour_gradient(rows, places, cam, degree, means, sh, paint, sums, basis, weights, work, out):
    """SH gradients into out[places, 11:]; the direction's are added to the means' in `work`."""
    bands = (degree + 1) * (degree + 1)
    x, y, z, distance = _direction(rows, cam, means)
    sh_basis(degree, x, y, z, basis)
    stride, columns = 3 * sh.shape[1], out.shape[1]
    for band in range(bands):
        dstore(weights, LANES * band, spread8(0.0))
    for channel in range(3):
        # a colour clamped at 0 passes nothing on
        painted = dgt(gather8(paint, rows, 4, channel), 0.0)
        g = dselect(painted, dload(sums, LANES * (6 + channel)), 0.0)
        for band in range(bands):
            scatter8(out, places, columns, 11 + 3 * band + channel, g * dload(basis, LANES * band))
            if degree > 0:
                added = g * gather8(sh, rows, stride, 3 * band + channel)
                dstore(weights, LANES * band, dload(weights, LANES * band) + added)
    if degree > 0:
        gx, gy, gz = sh_direction_gradient(degree, x, y, z, weights)
        along = gx * x + gy * y + gz * z
        dstore(work, 0, dload(work, 0) + (gx - along * x) / distance)
        dstore(work, LANES, dload(work, LANES) + (gy - along * y) / distance)
        dstore(work, 2 * LANES, dload(work, 2 * LANES) + (gz - along * z) / distance)


@kernel
def _sum_slots(raw, slot, end, lane, sums):
    """Add up the entries slot..end of raw [intersections, 9], in order, into a lane of `sums`."""
    first, rest = spread8(0.0), 0.0
    for s in range(slot, end):
        first = first + dload(raw, s * SUMS)
        rest += raw[s, 8]
    dstore(sums, lane * 16, first)
    sums[lane * 16 + 8] = rest


@kernel
def splat_gradients(
    ticket,
    chunk,
    visible,
    cam,
    degree,
    means,
    quaternions,
    log_scales,
    opacity_logits,
    sh,
    smoothing,
    geometry,
    paint,
    splats,
    raw,
    out,
    means2d,
):
    """Sum each splat's (splat, tile) gradients, in a fixed order, and take them to parameters.

    splats [V, 4]: `TileLists.places`.
    """
    n = len(visible)
    columns = out.shape[1]
    w = np.empty(WORK_ROW * LANES, np.float64)
    by_lane = np.zeros(16 * LANES, np.float64)
    sums = np.empty(SUMS * LANES, np.float64)
    work = np.empty(11 * LANES, np.float64)
    basis = np.empty(16 * LANES, np.float64)
    weights = np.empty(16 * LANES, np.float64)
    rows, places = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    lanes = np.arange(LANES)
    while True:
        first = take_ticket(ticket) * chunk
        if first >= n:
            break
        last = min(first + chunk, n)
        for start in range(first, last, LANES):
            _name_rows(places, start, last)
            for lane in range(LANES):
                place = places[lane]
                rows[lane] = visible[place]
                slot = np.int64(splats[place, SLOT])
                _sum_slots(raw, slot, slot + splats[place, COUNT], lane, by_lane)
                vstore(out, place * columns + columns - 16, splat16(np.float32(0.0)))
            for k in range(SUMS):
                dstore(sums, LANES * k, gather8(by_lane, lanes, 16, k))
            footprint(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w)
            _exponent_gradient(
                rows, cam, geometry, w, sums, len(smoothing) > 0, places, means2d, work
            )
            _colour_gradient(
                rows, places, cam, degree, means, sh, paint, sums, basis, weights, work, out
            )
            for k in range(11):
                scatter8(out, places, columns, k, dload(work, LANES * k))


@kernel
def _exponent_gradient(rows, cam, geometry, w, sums, smoothed, places, means2d, work):
    """From the sums over pixels that `blend.entry_gradient` describes to means2d and to the
    parameters' gradients in `work`."""
    a = gather8(geometry, rows, GEOMETRY_ROW, GA)
    b, k = gather8(geometry, rows, GEOMETRY_ROW, GB), gather8(geometry, rows, GEOMETRY_ROW, GK)
    s_u, s_t = dload(sums, 0), dload(sums, LANES)
    s_uu, s_tt = dload(sums, 2 * LANES), dload(sums, 3 * LANES)
    s_ut, s_1 = dload(sums, 4 * LANES), dload(sums, 5 * LANES)
    along = 2.0 * (b * k * s_t - a * s_u)
    across = -2.0 * b * s_t
    tall = dgt(at(w, C), at(w, A))  # whether the major axis is y
    g_x, g_y = dselect(tall, across, along), dselect(tall, along, across)
    g_opacity = -s_1 / used_opacity(w)
    footprint_gradient(cam, w, g_x, g_y, s_uu, s_tt, -2.0 * b * s_ut, g_opacity, smoothed, work)
    scatter8(means2d, places, 2, 0, g_x)
    scatter8(means2d, places, 2, 1, g_y)


@kernel
def sh_basis_values(degree, directions):
    """[N, (degree + 1)^2] basis functions of unit directions [N, 3], for looking at."""
    n, bands = len(directions), (degree + 1) * (degree + 1)
    out = np.empty((n, bands), np.float64)
    basis = np.empty(16 * LANES, np.float64)
    rows = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        _name_rows(rows, start, n)
        x, y = gather8(directions, rows, 3, 0), gather8(directions, rows, 3, 1)
        sh_basis(degree, x, y, gather8(directions, rows, 3, 2), basis)
        for band in range(bands):
            scatter8(out, rows, bands, band, dload(basis, LANES * band))
    return out
