"""The photographs in training, at every resolution of the schedule."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.photos.load import load_image
from stages.scene import Camera, View
from stages.training.schedule import RESOLUTIONS


@dataclass(frozen=True)
class TrainingView:
    """One photograph. levels: (camera, pixels [3, H, W] uint8) for each of RESOLUTIONS."""

    name: str
    levels: tuple[tuple[Camera, NDArray[np.uint8]], ...]

    def target(self, level: int) -> tuple[Camera, NDArray[np.float32]]:
        """The camera and its photograph [3, H, W] in [0, 1]."""
        camera, pixels = self.levels[level]
        return camera, np.multiply(pixels, np.float32(1 / 255), dtype=np.float32)


def load_views(folder: Path, views: Iterable[View], train_side: int) -> list[TrainingView]:
    """Photographs scaled so that their longer side is at most `train_side` pixels, and smaller."""
    loaded = []
    for view in views:
        levels = []
        for _, scale in RESOLUTIONS:
            camera = view.camera.fitted(max(16, round(train_side * scale)))
            picture = load_image(folder / view.image, camera.width, camera.height)
            pixels = np.round(picture * 255).astype(np.uint8)
            levels.append((camera, np.ascontiguousarray(pixels.transpose(2, 0, 1))))
        loaded.append(TrainingView(view.name, tuple(levels)))
    return loaded
