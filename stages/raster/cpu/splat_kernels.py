"""Kernels over splats: projection, colour, and gathering of gradients."""

from __future__ import annotations

import math

import numpy as np

from stages.raster.camera_row import CAMERA_CENTRE, CX, CY, DILATION, HEIGHT, WIDTH, R, T
from stages.raster.cpu.binning import COUNT, SLOT
from stages.raster.cpu.blend import S_1, S_RED, S_T, S_TT, S_U, S_UT, S_UU, SUMS
from stages.raster.cpu.projection import (
    GA,
    GB,
    GEOMETRY_ROW,
    GK,
    GRADIENTS,
    GVX,
    GVY,
    GX,
    GY,
    WORK_ROW,
    A,
    C,
    drawable,
    footprint,
    footprint_gradient,
    geometry_records,
    sums_origin,
    used_opacity,
)
from stages.raster.cpu.sh_kernels import sh_basis, sh_direction_gradient
from stages.raster.definition import COLOUR_MAX, MEAN, SH
from stages.raster.kernels.simd import (
    kernel,
    splat16,
    take_ticket,
    vstore,
)
from stages.raster.kernels.simd64 import (
    LANES,
    at,
    bits8,
    dand,
    dgt,
    dload,
    dmax,
    dmin,
    dselect,
    dsqrt,
    dstore,
    gather8,
    put,
    scatter8,
    spread8,
)

OUT_OF_VIEW, VISIBLE, CULLED = 0, 1, 2
LARGEST = 3.4e38  # near the largest float32: no gradient becomes infinite
_BRIGHTEST = float(np.float32(COLOUR_MAX))  # in float32, as in `paint`
_LN2 = math.log(2.0)


@kernel
def name_rows(rows, start, end):
    """The next eight rows from `start`; the last one is repeated beyond `end`."""
    for lane in range(LANES):
        rows[lane] = min(start + lane, end - 1)


@kernel
def _colours_are_finite(i, sh):
    for coefficient in range(sh.shape[1]):
        for channel in range(3):
            if not math.isfinite(sh[i, coefficient, channel]):
                return False
    return True


@kernel
def _block_of_colours_is_finite(start, sh):
    """Whether eight rows from `start` have finite colours only; 0 x value is 0 if it is finite."""
    size = sh.shape[1] * 3
    nothing = spread8(0.0)
    for k in range(size):
        nothing = nothing + 0.0 * dload(sh, start * size + LANES * k)
    return bits8(dgt(1.0, nothing)) == 255


@kernel
def project_splats(ticket, chunk, cam, degree, splats, geometry, paint, status):
    """Geometry record, paint and status (0 out of view, 1 visible, 2 not drawable) of each row.

    splats: means, quaternions, log_scales, opacity_logits, sh, smoothing. geometry [N, 8],
    paint [N, 4] (colour and depth): filled for visible rows only.
    """
    means, quaternions, log_scales, opacity_logits, sh, smoothing = splats
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
            name_rows(rows, start, last)
            good = bits8(drawable(rows, means, quaternions, log_scales, opacity_logits, smoothing))
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
    x = gather8(means, rows, 3, 0) - cam[CAMERA_CENTRE]
    y = gather8(means, rows, 3, 1) - cam[CAMERA_CENTRE + 1]
    z = gather8(means, rows, 3, 2) - cam[CAMERA_CENTRE + 2]
    distance = dsqrt(x * x + y * y + z * z)
    return x / distance, y / distance, z / distance, distance


@kernel
def _shade(rows, cam, degree, means, sh, basis, paint):
    x, y, z, _ = _direction(rows, cam, means)
    sh_basis(degree, x, y, z, basis)
    stride = 3 * sh.shape[1]
    for channel in range(3):
        value = spread8(0.5)
        for coefficient in range((degree + 1) * (degree + 1)):
            value = value + at(basis, coefficient) * gather8(
                sh, rows, stride, 3 * coefficient + channel
            )
        scatter8(paint, rows, 4, channel, dmin(dmax(value, 0.0), COLOUR_MAX))
    mx, my, mz = gather8(means, rows, 3, 0), gather8(means, rows, 3, 1), gather8(means, rows, 3, 2)
    depth = cam[R + 6] * mx + cam[R + 7] * my + cam[R + 8] * mz + cam[T + 2]
    scatter8(paint, rows, 4, 3, depth)


@kernel
def _colour_gradient(rows, places, cam, degree, means, sh, paint, sums, basis, weights, work, out):
    """SH gradients into out[places, SH:]; the directions' are added to the means' in `work`."""
    coefficients = (degree + 1) * (degree + 1)
    x, y, z, distance = _direction(rows, cam, means)
    sh_basis(degree, x, y, z, basis)
    stride, columns = 3 * sh.shape[1], out.shape[1]
    for coefficient in range(coefficients):
        put(weights, coefficient, spread8(0.0))
    for channel in range(3):
        # a clamped colour has no gradient
        colour = gather8(paint, rows, 4, channel)
        painted = dand(dgt(colour, 0.0), dgt(_BRIGHTEST, colour))
        g = dselect(painted, at(sums, S_RED + channel), 0.0)
        for coefficient in range(coefficients):
            scatter8(
                out, places, columns, SH + 3 * coefficient + channel, g * at(basis, coefficient)
            )
            if degree > 0:
                added = g * gather8(sh, rows, stride, 3 * coefficient + channel)
                put(weights, coefficient, at(weights, coefficient) + added)
    if degree > 0:
        gx, gy, gz = sh_direction_gradient(degree, x, y, z, weights)
        along = gx * x + gy * y + gz * z
        put(work, MEAN, at(work, MEAN) + (gx - along * x) / distance)
        put(work, MEAN + 1, at(work, MEAN + 1) + (gy - along * y) / distance)
        put(work, MEAN + 2, at(work, MEAN + 2) + (gz - along * z) / distance)


@kernel
def _sum_slots(raw, slot, end, lane, sums):
    """Add up entries slot..end of raw [intersections, SUMS], in order, into a lane of `sums`."""
    first, rest = spread8(0.0), 0.0
    for s in range(slot, end):
        first = first + dload(raw, s * SUMS)
        rest += raw[s, LANES]
    dstore(sums, lane * 16, first)
    sums[lane * 16 + LANES] = rest


@kernel
def splat_gradients(ticket, chunk, visible, cam, degree, splats, tiles, found, raw, out, means2d):
    """Sum each splat's (splat, tile) gradients in a fixed order, and continue to its parameters.

    splats: as in `project_splats`. tiles: see `DrawnTiles`. found [V, 4]: `Forward.places`.
    """
    means, quaternions, log_scales, opacity_logits, sh, smoothing = splats
    geometry, paint = tiles[6:8]
    n = len(visible)
    columns = out.shape[1]
    w = np.empty(WORK_ROW * LANES, np.float64)
    by_lane = np.zeros(16 * LANES, np.float64)
    sums = np.empty(SUMS * LANES, np.float64)
    work = np.empty(GRADIENTS * LANES, np.float64)
    shifts = np.empty(4 * LANES, np.float64)
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
            name_rows(places, start, last)
            for lane in range(LANES):
                place = places[lane]
                rows[lane] = visible[place]
                slot = np.int64(found[place, SLOT])
                _sum_slots(raw, slot, slot + found[place, COUNT], lane, by_lane)
                vstore(out, place * columns + columns - 16, splat16(np.float32(0.0)))
            for k in range(SUMS):
                put(sums, k, gather8(by_lane, lanes, 16, k))
            footprint(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w)
            _exponent_gradient(
                rows, cam, geometry, w, sums, shifts, len(smoothing) > 0, places, means2d, work
            )
            _colour_gradient(
                rows, places, cam, degree, means, sh, paint, sums, basis, weights, work, out
            )
            for k in range(GRADIENTS):
                value = dmin(dmax(at(work, k), -LARGEST), LARGEST)
                scatter8(out, places, columns, k, value)


@kernel
def _shifts(rows, cam, geometry, shifts):
    """The origins of the sums of eight rows (see `sums_origin`), along and across: minus the mean
    (0:2) and minus the principal point (2:4), each 8 lanes of `shifts`."""
    for lane in range(LANES):
        row = rows[lane]
        o, p, q = sums_origin(geometry, row, cam[WIDTH], cam[HEIGHT])
        x, y, cx, cy, k = geometry[row, GX], geometry[row, GY], cam[CX], cam[CY], geometry[row, GK]
        if geometry[row, GVX] < geometry[row, GVY]:
            x, y, cx, cy = y, x, cy, cx
        shifts[lane] = o - x
        shifts[LANES + lane] = q - y - k * (p - x)
        shifts[2 * LANES + lane] = o - cx
        shifts[3 * LANES + lane] = q - cy - k * (p - cx)


@kernel
def _exponent_gradient(rows, cam, geometry, w, sums, shifts, smoothed, places, means2d, work):
    """From the sums over pixels that `blend.entry_gradient` describes to means2d and to the
    parameters' gradients in `work`.

    With q the exponent's gradient with respect to a pixel's offset, p a pixel and c the principal
    point, the derivative of the exponent by ln(1 / z) is -(q (p - c) - e q^2). So the two large
    terms that cancel for a distant mean (its motion, and the footprint's scaling) are never formed.
    """
    root_a = gather8(geometry, rows, GEOMETRY_ROW, GA)
    root_b, k = gather8(geometry, rows, GEOMETRY_ROW, GB), gather8(geometry, rows, GEOMETRY_ROW, GK)
    a, b = _LN2 * root_a * root_a, _LN2 * root_b * root_b
    _shifts(rows, cam, geometry, shifts)
    du, dt = dload(shifts, 0), dload(shifts, LANES)
    near_u, near_t, s_1 = at(sums, S_U), at(sums, S_T), at(sums, S_1)
    s_u, s_t = near_u + du * s_1, near_t + dt * s_1
    by_u, by_t = at(sums, S_UU) + du * near_u, at(sums, S_TT) + dt * near_t
    s_uu, s_tt = by_u + du * s_u, by_t + dt * s_t
    s_ut = at(sums, S_UT) + du * near_t + dt * s_u
    along = 2.0 * (b * k * s_t - a * s_u)
    across = -2.0 * b * s_t
    tall = dgt(at(w, C), at(w, A))  # whether the major axis is y
    g_x, g_y = dselect(tall, across, along), dselect(tall, along, across)
    q_p = a * (by_u + dload(shifts, 2 * LANES) * s_u) + b * (by_t + dload(shifts, 3 * LANES) * s_t)
    q_q = a * a * s_uu - 2.0 * a * b * k * s_ut + b * b * (1.0 + k * k) * s_tt
    g_near = 4.0 * cam[DILATION] * q_q - 2.0 * q_p
    g_opacity = -s_1 / used_opacity(w)
    footprint_gradient(
        cam, w, g_x, g_y, s_uu, s_tt, -2.0 * b * s_ut, g_near, g_opacity, smoothed, work
    )
    scatter8(means2d, places, 2, 0, g_x)
    scatter8(means2d, places, 2, 1, g_y)
