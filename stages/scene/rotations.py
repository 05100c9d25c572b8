"""Rotation matrices, unit quaternions w, x, y, z, and similarity transforms between points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Weight of `turns` in `similarity`. They decide the turn about an axis if no point is further from
# it than a tenth of its length. They hardly change what points in a plane or in space say.
TURNS_WEIGHT = 0.01


def quaternions_of(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 4] unit, w >= 0, of rotation matrices [..., 3, 3]: the eigenvector of Bar-Itzhack's
    symmetric matrix (J. Guidance 23(6), 2000), which is stable for every angle."""
    rows = np.moveaxis(np.asarray(rotations, np.float64), (-2, -1), (0, 1))
    (a, b, c), (d, e, f), (g, h, i) = rows
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternions = np.linalg.eigh(np.moveaxis(matrix, (0, 1), (-2, -1)))[1][..., 3]
    return np.where(quaternions[..., :1] >= 0, quaternions, -quaternions)


def matrices_of(quaternions: NDArray[np.floating]) -> NDArray[np.float64]:
    """[..., 3, 3] of quaternions [..., 4] w, x, y, z of any length but 0."""
    q = np.asarray(quaternions, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def similarity(
    a: NDArray[np.float64], b: NDArray[np.float64], turns: NDArray[np.float64] | None = None
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """(scale, rotation [3, 3], offset [3]) that take points a [N, 3] nearest b by
    scale * rotation @ a + offset (Umeyama 1991).

    turns: [M, 3, 3] estimates of the rotation, as those of cameras at the points, for what the
    points leave open: without them it is one of many solutions for collinear or equal points.
    """
    mean_a, mean_b = a.mean(0), b.mean(0)
    covariance = (b - mean_b).T @ (a - mean_a) / len(a)
    nearest = covariance
    if turns is not None:
        nearest = covariance / (np.linalg.norm(covariance) or 1.0) + TURNS_WEIGHT * turns.mean(0)
    u, _, vt = np.linalg.svd(nearest)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    spread = max(float(np.square(a - mean_a).sum(1).mean()), 1e-300)
    scale = float((rotation * covariance).sum() / spread)
    return scale, rotation, mean_b - scale * rotation @ mean_a
