"""One splat's picture in 60 digits, by the textbook, and its gradients by differences."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from stages.raster.camera_row import clamp_limits
from stages.raster.definition import RasterSettings
from stages.raster.sh import C0
from tests.scenes import PARAMETERS

DIGITS = 140  # of which a difference of steps of 1e-30 loses a good half
STEP = Decimal(10) ** -30
NAMES = PARAMETERS[:4]


def exact_gradients(scene, view, v_image):
    """{parameter: gradient of sum(image x v_image)} of a scene of one splat of degree 0, for all
    but its colours. The camera stands at the origin."""
    with localcontext() as context:
        context.prec = DIGITS
        start = {n: [Decimal(float(v)) for v in getattr(scene, n).reshape(-1)] for n in NAMES}
        rgb = [max(0.5 + C0 * float(c), 0.0) for c in scene.sh[0, 0]]
        weights = (np.asarray(v_image, np.float64) @ rgb).astype(object)
        weights = np.vectorize(Decimal, otypes=[object])(weights)
        return {
            name: np.array(
                [_slope(start, name, i, view, weights) for i in range(len(start[name]))], np.float64
            ).reshape(getattr(scene, name).shape)
            for name in NAMES
        }


def _slope(start, name, i, view, weights):
    step = STEP * max(abs(start[name][i]), Decimal(1))
    sums = []
    for sign in (1, -1):
        moved = {n: list(values) for n, values in start.items()}
        moved[name][i] += sign * step
        sums.append((_alpha(moved, view) * weights).sum())
    return float((sums[0] - sums[1]) / (2 * step))


def _alpha(p, view):
    """[H, W] of Decimals; no pixel may be at the cap or below the cut-off."""
    (x, y, z), dilation = p["means"], Decimal(RasterSettings().dilation_px2)
    fx, fy, cx, cy = (Decimal(float(v)) for v in (view.fx, view.fy, view.cx, view.cy))
    low_x, high_x, low_y, high_y = (Decimal(v) for v in clamp_limits(view))
    u, v = min(max(x / z, low_x), high_x), min(max(y / z, low_y), high_y)
    jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]], object)
    scales = np.array([s.exp() for s in p["log_scales"]], object)
    rows = jacobian @ _rotation(p["quaternions"]) * scales
    a, b, c = rows[0] @ rows[0] + dilation, rows[0] @ rows[1], rows[1] @ rows[1] + dilation
    det = a * c - b * b
    opacity = 1 / (1 + (-p["opacity_logits"][0]).exp())
    half = Decimal("0.5")
    dx = np.array([k + half - fx * x / z - cx for k in range(view.width)], object)[None]
    dy = np.array([k + half - fy * y / z - cy for k in range(view.height)], object)[:, None]
    power = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (2 * det)
    return opacity * np.vectorize(lambda e: (-e).exp(), otypes=[object])(power)


def _rotation(q):
    norm = sum(k * k for k in q).sqrt()
    w, x, y, z = (k / norm for k in q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        object,
    )
