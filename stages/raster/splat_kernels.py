"""The kernels that run over splats: projecting, shading, and gathering gradients."""

from __future__ import annotations

import math

import numpy as np

from stages.raster.projection import (
    GEOMETRY_ROW,
    GVX,
    GVY,
    WORK_ROW,
    footprint,
    footprint_gradient,
    geometry_record,
    is_drawable,
)
from stages.raster.sh import sh_basis, sh_direction_gradient
from stages.raster.simd import kernel, take_ticket

OUT_OF_VIEW, VISIBLE, CULLED = 0, 1, 2


@kernel
def project_splats(
    ticket,
    chunk,
    cam,
    means,
    quaternions,
    log_scales,
    opacity_logits,
    sh,
    geometry,
    depth,
    status,
):
    """Geometry record, depth and status (0 out of view, 1 visible, 2 not drawable) of each row."""
    n = len(means)
    w = np.empty(WORK_ROW, np.float64)
    while True:
        start = take_ticket(ticket) * chunk
        if start >= n:
            break
        for i in range(start, min(start + chunk, n)):
            status[i] = OUT_OF_VIEW
            if not is_drawable(i, means, quaternions, log_scales, opacity_logits, sh):
                status[i] = CULLED
            elif footprint(
                i, cam, means, quaternions, log_scales, opacity_logits, w
            ) and geometry_record(cam, w, geometry, i):
                status[i] = VISIBLE
                depth[i] = np.float32(w[2])


@kernel
def _direction(i, cam, means):
    """(unit x, y, z, distance) from the camera to row i."""
    x, y, z = means[i, 0] - cam[23], means[i, 1] - cam[24], means[i, 2] - cam[25]
    distance = math.sqrt(x * x + y * y + z * z)
    return x / distance, y / distance, z / distance, distance


@kernel
def shade_splats(ticket, chunk, order, all_geometry, cam, degree, means, sh, geometry, paint):
    """Records in blending order, and paint [V, 4]: colour and depth of each visible splat."""
    n = len(order)
    basis = np.empty(16, np.float64)
    bands = (degree + 1) * (degree + 1)
    while True:
        start = take_ticket(ticket) * chunk
        if start >= n:
            break
        for rank in range(start, min(start + chunk, n)):
            i = order[rank]
            for k in range(GEOMETRY_ROW):
                geometry[rank, k] = all_geometry[i, k]
            x, y, z, _ = _direction(i, cam, means)
            sh_basis(degree, x, y, z, basis)
            for channel in range(3):
                value = 0.5
                for band in range(bands):
                    value += basis[band] * sh[i, band, channel]
                paint[rank, channel] = np.float32(max(value, 0.0))
            paint[rank, 3] = np.float32(
                cam[6] * means[i, 0] + cam[7] * means[i, 1] + cam[8] * means[i, 2] + cam[11]
            )


@kernel
def _colour_gradient(
    i, cam, degree, means, sh, paint, rank, total, basis, weights, parameters, out
):
    """SH gradients into out[rank, 11:]; the direction's are added to parameters[0:3]."""
    bands = (degree + 1) * (degree + 1)
    x, y, z, distance = _direction(i, cam, means)
    sh_basis(degree, x, y, z, basis)
    for band in range(bands):
        weights[band] = 0.0
        for channel in range(3):
            # a colour clamped at 0 passes nothing on
            g = total[6 + channel] if paint[rank, channel] > 0.0 else 0.0
            out[rank, 11 + 3 * band + channel] = np.float32(g * basis[band])
            weights[band] += g * sh[i, band, channel]
    if degree > 0:
        gx, gy, gz = sh_direction_gradient(degree, x, y, z, weights)
        along = gx * x + gy * y + gz * z
        parameters[0] += (gx - along * x) / distance
        parameters[1] += (gy - along * y) / distance
        parameters[2] += (gz - along * z) / distance


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
    geometry,
    paint,
    slot_starts,
    raw,
    out,
    means2d,
):
    """Sum each splat's (splat, tile) gradients, in a fixed order, and take them to parameters."""
    n = len(visible)
    w = np.empty(WORK_ROW, np.float64)
    total = np.empty(9, np.float64)
    g = np.empty(6, np.float64)
    parameters = np.empty(11, np.float64)
    basis = np.empty(16, np.float64)
    weights = np.empty(16, np.float64)
    used = 11 + 3 * (degree + 1) * (degree + 1)
    while True:
        start = take_ticket(ticket) * chunk
        if start >= n:
            break
        for rank in range(start, min(start + chunk, n)):
            i = visible[rank]
            for k in range(9):
                total[k] = 0.0
            for slot in range(slot_starts[rank], slot_starts[rank + 1]):
                for k in range(9):
                    total[k] += raw[slot, k]
            wide = geometry[rank, GVX] >= geometry[rank, GVY]
            g[0] = total[0] if wide else total[1]
            g[1] = total[1] if wide else total[0]
            for k in range(2, 6):
                g[k] = total[k]
            footprint(i, cam, means, quaternions, log_scales, opacity_logits, w)
            footprint_gradient(cam, w, g, parameters)
            _colour_gradient(
                i, cam, degree, means, sh, paint, rank, total, basis, weights, parameters, out
            )
            for k in range(11):
                out[rank, k] = np.float32(parameters[k])
            for k in range(used, out.shape[1]):
                out[rank, k] = np.float32(0.0)
            means2d[rank, 0], means2d[rank, 1] = np.float32(g[0]), np.float32(g[1])
