"""Scenes to make fewer splats of."""

from __future__ import annotations

import numpy as np

from stages.scene import Splats
from tests import scenes


def wall(n: int, seed: int = 0) -> Splats:
    """Small discs on the plane z = 0, three by three, in soft colours."""
    r = np.random.default_rng(seed)
    means = np.concatenate([r.uniform(-1.5, 1.5, (n, 2)), r.normal(0, 0.01, (n, 1))], 1)
    rgb = 0.5 + 0.3 * np.sin(2 * means + [0, 1, 2])
    size = 2.5 / np.sqrt(n)
    return scenes.splats(means, [size, size, 0.1 * size], r.uniform(0.3, 0.9, n), rgb)
