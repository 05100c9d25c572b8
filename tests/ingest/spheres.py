"""360-degree pictures made for tests."""

from __future__ import annotations

import numpy as np


def sphere(seed: int = 0, width: int = 512) -> np.ndarray:
    """[W / 2, W, 3] uint8 of a made scene: waves over the directions of the whole sphere."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: width // 2, :width] + 0.5
    longitude, latitude = 2 * np.pi * x / width, np.pi * (0.5 - 2 * y / width)
    direction = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        axis=-1,
    )
    waves = [
        np.sin(direction @ rng.normal(0, 6, 3) + rng.uniform(0, 6))[..., None]
        * rng.uniform(0, 1, 3)
        for _ in range(12)
    ]
    return np.clip(128 + 30 * np.sum(waves, axis=0), 0, 255).astype(np.uint8)


def two_fisheyes(seed: int = 0) -> np.ndarray:
    """[256, 512, 3] uint8 two circles of a made scene, side by side on black."""
    y, x = np.mgrid[:256, :512] + 0.5
    away = np.minimum(np.hypot(x - 128, y - 128), np.hypot(x - 384, y - 128))
    return np.where((away < 128)[..., None], sphere(seed), 0).astype(np.uint8)
