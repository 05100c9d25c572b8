"""The photographs in training, at every resolution of the schedule."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.measure.judge import load_photograph
from stages.scene import Camera, View
from stages.scene.light import Light
from stages.training.loss import channel_means
from stages.training.schedule import RESOLUTIONS


@dataclass(frozen=True)
class Level:
    """A photograph at one size: pixels [3, H, W] and the mean of each channel [3], in 0..1. mask
    [H, W], outside: as in `scene.Photo`; None where everything counts. light: to be taken out of
    the pixels; None for none. See `training.target`."""

    camera: Camera
    pixels: NDArray[np.uint8]
    means: NDArray[np.float32]
    mask: NDArray[np.uint8] | None = None
    outside: str = ""
    light: Light | None = None

    @property
    def plain(self) -> bool:
        """Whether its pixels are what a drawing is compared with, as they are."""
        return self.mask is None and self.light is None


@dataclass(frozen=True)
class TrainingView:
    """One photograph, at each of RESOLUTIONS."""

    name: str
    levels: tuple[Level, ...]


def load_views(
    folder: Path, views: Iterable[View], train_side: int, light: bool = False
) -> list[TrainingView]:
    """Photographs scaled so that their longer side is at most `train_side` pixels, and smaller.
    light: whether to be brought to their median light."""
    loaded = []
    for view in views:
        levels = []
        for _, scale in RESOLUTIONS:
            camera = view.camera.fitted(max(16, round(train_side * scale)))
            photograph = load_photograph(folder, view, camera)
            planar = np.ascontiguousarray(photograph.pixels.transpose(2, 0, 1))
            means = channel_means(planar)
            masked = photograph.mask, view.outside
            levels.append(Level(camera, planar, means, *masked, view.light if light else None))
        loaded.append(TrainingView(view.name, tuple(levels)))
    return loaded
