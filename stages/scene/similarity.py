"""The similarity transform between two sets of corresponding points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def similarity(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """(scale, rotation [3, 3], offset [3]) that take points a [N, 3] nearest b by
    scale * rotation @ a + offset (Umeyama 1991). For collinear or
    equal points it is one of many solutions."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, sizes, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    spread = max(float(np.square(a - mean_a).sum(1).mean()), 1e-300)
    scale = float((sizes * signs).sum() / spread)
    return scale, rotation, mean_b - scale * rotation @ mean_a
