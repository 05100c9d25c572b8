"""Footprints of splats on the picture, and the way back to their parameters, one splat at a time.

All of it in float64: it costs next to nothing beside blending, and takes overflow, the loss of
the determinant and far-away centres off the list of worries. Formulas as in `reference`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.raster.api import ALPHA_MIN, LOG_SCALE_MAX, QUATERNION_MIN, RasterSettings
from stages.raster.simd import kernel
from stages.scene import Camera

# Camera row: rotation 0:9, translation 9:12, fx fy cx cy 12:16, clamp limits 16:20 (low x, high x,
# low y, high y), near 20, dilation 21, antialias 22, centre 23:26, width 26, height 27.
CAMERA_ROW = 28

# Work row (float64[40], one a thread): filled by `footprint`, read by `footprint_gradient`.
AT = 0  # 0:3 position in the camera
V0, V1 = 3, 6  # rows of V = J W R diag(s)
AXES = 9  # 9:18 W R
SCALES = 18  # 18:21
CROSS = 21  # 21:24 V0 x V1
A, B, C, DET, MINORS = 24, 25, 26, 27, 28
OPACITY, COMPENSATION = 29, 30
NORM, QUATERNION = 31, 32  # 32:36 unit
SLOPE = 36  # 36:38 clamped x/z, y/z
INSIDE = 38  # 38:40 whether the slope was inside its limits
WORK_ROW = 40

# Geometry record of a visible splat, float64[8]: mean in pixels, the three numbers of the
# exponent A u^2 + B (v - K u)^2 (u along the axis of the larger variance), opacity, variances.
GEOMETRY_ROW = 8
GX, GY, GA, GB, GK, GO, GVX, GVY = range(8)


def camera_row(camera: Camera, settings: RasterSettings) -> NDArray[np.float64]:
    """The camera and the settings as the numbers that kernels read."""
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    limits = (
        -camera.cx / camera.fx - margin_x,
        (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )
    return np.concatenate(
        [
            camera.world_to_camera[:3, :3].ravel(),
            camera.world_to_camera[:3, 3],
            (camera.fx, camera.fy, camera.cx, camera.cy),
            limits,
            (settings.near, settings.dilation_px2, float(settings.antialias)),
            camera.centre,
            (camera.width, camera.height),
        ]
    )


@kernel
def is_drawable(i, means, quaternions, log_scales, opacity_logits, sh):
    """Whether all values of row i are finite and in the range that can be drawn."""
    if not math.isfinite(opacity_logits[i]):
        return False
    largest = 0.0
    good = True
    for k in range(4):
        largest = max(largest, abs(quaternions[i, k]))
        good &= math.isfinite(quaternions[i, k])
    for k in range(3):
        good &= math.isfinite(means[i, k]) and math.isfinite(log_scales[i, k])
        good &= log_scales[i, k] <= LOG_SCALE_MAX
    for band in range(sh.shape[1]):
        for channel in range(3):
            good &= math.isfinite(sh[i, band, channel])
    return good and largest >= QUATERNION_MIN


@kernel
def footprint(i, cam, means, quaternions, log_scales, opacity_logits, w):
    """Fill the work row `w` for row i; False where the splat is not in front of the camera."""
    mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    z = cam[6] * mx + cam[7] * my + cam[8] * mz + cam[11]
    if not z > cam[20]:
        return False
    x = cam[0] * mx + cam[1] * my + cam[2] * mz + cam[9]
    y = cam[3] * mx + cam[4] * my + cam[5] * mz + cam[10]
    w[0], w[1], w[2] = x, y, z
    _axes(i, cam, quaternions, w)
    slope_x, slope_y = x / z, y / z
    u = min(max(slope_x, cam[16]), cam[17])
    v = min(max(slope_y, cam[18]), cam[19])
    w[SLOPE], w[SLOPE + 1] = u, v
    w[INSIDE] = 1.0 if u == slope_x else 0.0
    w[INSIDE + 1] = 1.0 if v == slope_y else 0.0
    j00, j02 = cam[12] / z, -cam[12] * u / z
    j11, j12 = cam[13] / z, -cam[13] * v / z
    a, b, c = 0.0, 0.0, 0.0
    for k in range(3):
        s = math.exp(np.float64(log_scales[i, k]))
        w[SCALES + k] = s
        v0 = (j00 * w[AXES + k] + j02 * w[AXES + 6 + k]) * s
        v1 = (j11 * w[AXES + 3 + k] + j12 * w[AXES + 6 + k]) * s
        w[V0 + k], w[V1 + k] = v0, v1
        a += v0 * v0
        b += v0 * v1
        c += v1 * v1
    w[CROSS] = w[V0 + 1] * w[V1 + 2] - w[V0 + 2] * w[V1 + 1]
    w[CROSS + 1] = w[V0 + 2] * w[V1] - w[V0] * w[V1 + 2]
    w[CROSS + 2] = w[V0] * w[V1 + 1] - w[V0 + 1] * w[V1]
    minors = w[CROSS] ** 2 + w[CROSS + 1] ** 2 + w[CROSS + 2] ** 2
    e = cam[21]
    w[A], w[B], w[C] = a + e, b, c + e
    w[MINORS] = minors
    w[DET] = minors + e * (a + c) + e * e
    w[OPACITY] = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[i])))
    w[COMPENSATION] = 1.0
    if cam[22] != 0.0:
        w[COMPENSATION] = math.sqrt(max(minors, 1e-60) / w[DET])
    return True


@kernel
def _axes(i, cam, quaternions, w):
    """W R(q) into the work row; scaled before it is normalised, so that no square overflows."""
    q0, q1 = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    q2, q3 = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    top = max(max(abs(q0), abs(q1)), max(abs(q2), abs(q3)))
    norm = math.sqrt((q0 / top) ** 2 + (q1 / top) ** 2 + (q2 / top) ** 2 + (q3 / top) ** 2)
    q0, q1, q2, q3 = q0 / top / norm, q1 / top / norm, q2 / top / norm, q3 / top / norm
    w[NORM] = norm * top
    w[QUATERNION], w[QUATERNION + 1] = q0, q1
    w[QUATERNION + 2], w[QUATERNION + 3] = q2, q3
    r00, r01, r02 = 1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)
    r10, r11, r12 = 2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)
    r20, r21, r22 = 2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)
    for row in range(3):
        c0, c1, c2 = cam[3 * row], cam[3 * row + 1], cam[3 * row + 2]
        w[AXES + 3 * row] = c0 * r00 + c1 * r10 + c2 * r20
        w[AXES + 3 * row + 1] = c0 * r01 + c1 * r11 + c2 * r21
        w[AXES + 3 * row + 2] = c0 * r02 + c1 * r12 + c2 * r22


@kernel
def geometry_record(cam, w, geometry, i):
    """geometry[i] of a splat from its work row; False where it touches no pixel of the picture."""
    opacity = w[OPACITY] * w[COMPENSATION]
    if not opacity >= ALPHA_MIN:
        return False
    a, b, c, det = w[A], w[B], w[C], w[DET]
    if not (det < 1e300 and det > 0.0):
        return False
    x = cam[12] * w[0] / w[2] + cam[14]
    y = cam[13] * w[1] / w[2] + cam[15]
    reach2 = 2.0 * math.log(max(opacity / ALPHA_MIN, 1.0))
    half_x, half_y = math.sqrt(reach2 * a), math.sqrt(reach2 * c)
    if x + half_x < 0.5 or x - half_x > cam[26] - 0.5:
        return False
    if y + half_y < 0.5 or y - half_y > cam[27] - 0.5:
        return False
    major = max(a, c)
    geometry[i, GX], geometry[i, GY] = x, y
    geometry[i, GA] = 0.5 / major
    geometry[i, GB] = 0.5 * major / det
    geometry[i, GK] = b / major
    geometry[i, GO] = opacity
    geometry[i, GVX], geometry[i, GVY] = a, c
    return True


@kernel
def footprint_gradient(cam, w, g, out):
    """Chain rule from a splat's footprint to its parameters.

    g[6]: gradients of mean x, mean y (px), A, B, K of the exponent and the opacity used.
    out[11]: gradients of mean (3), quaternion (4), log-scales (3) and opacity logit.
    """
    a, b, c, det = w[A], w[B], w[C], w[DET]
    major = max(a, c)
    g_major = -0.5 * g[2] / (major * major) + 0.5 * g[3] / det - g[4] * b / (major * major)
    g_b = g[4] / major
    g_det = -0.5 * g[3] * major / (det * det)
    g_a, g_c = (g_major, 0.0) if a >= c else (0.0, g_major)
    g_minors = 0.0
    opacity, compensation = w[OPACITY], w[COMPENSATION]
    if cam[22] != 0.0:
        g_compensation = g[5] * opacity
        g_det -= 0.5 * g_compensation * compensation / det
        if w[MINORS] > 1e-60:
            g_minors += 0.5 * g_compensation / (compensation * det)
    out[10] = g[5] * compensation * opacity * (1.0 - opacity)
    g_minors += g_det
    e2 = 2.0 * cam[21] * g_det

    x, y, z = w[0], w[1], w[2]
    fx, fy = cam[12], cam[13]
    u, v = w[SLOPE], w[SLOPE + 1]
    j00, j02, j11, j12 = fx / z, -fx * u / z, fy / z, -fy * v / z
    g00, g02, g11, g12 = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        n, m = (k + 1) % 3, (k + 2) % 3
        v0, v1 = w[V0 + k], w[V1 + k]
        # d|V0 x V1|^2 / dV0 = 2 V1 x (V0 x V1), and / dV1 = 2 (V0 x V1) x V0
        d0 = w[V1 + n] * w[CROSS + m] - w[V1 + m] * w[CROSS + n]
        d1 = w[CROSS + n] * w[V0 + m] - w[CROSS + m] * w[V0 + n]
        g_v0 = 2.0 * g_a * v0 + g_b * v1 + e2 * v0 + 2.0 * g_minors * d0
        g_v1 = 2.0 * g_c * v1 + g_b * v0 + e2 * v1 + 2.0 * g_minors * d1
        out[7 + k] = g_v0 * v0 + g_v1 * v1
        t0, t1 = g_v0 * w[SCALES + k], g_v1 * w[SCALES + k]
        g00 += t0 * w[AXES + k]
        g02 += t0 * w[AXES + 6 + k]
        g11 += t1 * w[AXES + 3 + k]
        g12 += t1 * w[AXES + 6 + k]
        # from here on these columns hold the gradient of W R
        w[AXES + k], w[AXES + 3 + k], w[AXES + 6 + k] = j00 * t0, j11 * t1, j02 * t0 + j12 * t1
    _quaternion_gradient(cam, w, out)

    g_x, g_y = g[0] * fx / z, g[1] * fy / z
    g_z = -(g[0] * fx * x + g[1] * fy * y) / (z * z)
    g_z += (-g00 * fx + g02 * fx * u - g11 * fy + g12 * fy * v) / (z * z)
    if w[INSIDE] != 0.0:
        g_u = -g02 * fx / z
        g_x += g_u / z
        g_z -= g_u * u / z
    if w[INSIDE + 1] != 0.0:
        g_v = -g12 * fy / z
        g_y += g_v / z
        g_z -= g_v * v / z
    for k in range(3):
        out[k] = cam[k] * g_x + cam[3 + k] * g_y + cam[6 + k] * g_z


@kernel
def _quaternion_gradient(cam, w, out):
    """out[3:7] from the gradient of W R that stands in the work row's AXES."""
    q0, q1 = w[QUATERNION], w[QUATERNION + 1]
    q2, q3 = w[QUATERNION + 2], w[QUATERNION + 3]
    r00 = cam[0] * w[AXES] + cam[3] * w[AXES + 3] + cam[6] * w[AXES + 6]
    r01 = cam[0] * w[AXES + 1] + cam[3] * w[AXES + 4] + cam[6] * w[AXES + 7]
    r02 = cam[0] * w[AXES + 2] + cam[3] * w[AXES + 5] + cam[6] * w[AXES + 8]
    r10 = cam[1] * w[AXES] + cam[4] * w[AXES + 3] + cam[7] * w[AXES + 6]
    r11 = cam[1] * w[AXES + 1] + cam[4] * w[AXES + 4] + cam[7] * w[AXES + 7]
    r12 = cam[1] * w[AXES + 2] + cam[4] * w[AXES + 5] + cam[7] * w[AXES + 8]
    r20 = cam[2] * w[AXES] + cam[5] * w[AXES + 3] + cam[8] * w[AXES + 6]
    r21 = cam[2] * w[AXES + 1] + cam[5] * w[AXES + 4] + cam[8] * w[AXES + 7]
    r22 = cam[2] * w[AXES + 2] + cam[5] * w[AXES + 5] + cam[8] * w[AXES + 8]
    n0 = 2.0 * (q1 * (r21 - r12) + q2 * (r02 - r20) + q3 * (r10 - r01))
    n1 = 2.0 * (q2 * (r01 + r10) + q3 * (r02 + r20) + q0 * (r21 - r12)) - 4.0 * q1 * (r11 + r22)
    n2 = 2.0 * (q1 * (r01 + r10) + q3 * (r12 + r21) + q0 * (r02 - r20)) - 4.0 * q2 * (r00 + r22)
    n3 = 2.0 * (q1 * (r02 + r20) + q2 * (r12 + r21) + q0 * (r10 - r01)) - 4.0 * q3 * (r00 + r11)
    along = n0 * q0 + n1 * q1 + n2 * q2 + n3 * q3
    out[3] = (n0 - along * q0) / w[NORM]
    out[4] = (n1 - along * q1) / w[NORM]
    out[5] = (n2 - along * q2) / w[NORM]
    out[6] = (n3 - along * q3) / w[NORM]
