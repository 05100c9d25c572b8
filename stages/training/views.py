"""The training views, at every resolution of the schedule."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from stages.measure.evaluation import load_evaluation_view
from stages.photos.album import Album
from stages.scene import Camera, View
from stages.scene.light import Light
from stages.training.loss import channel_means
from stages.training.schedule import RESOLUTIONS


@dataclass(frozen=True)
class Level:
    """A training view at one size.

    Args:
        camera: of that size.
        pixels: [3, H, W].
        means: [3] the mean of each channel, in 0..1.
        mask: [H, W], as in `scene.Photo`; None if all pixels count. See `training.target`.
        outside: what the mask means, as in `scene.Photo`.
        light: exposure and white balance to correct; None for none.
    """

    camera: Camera
    pixels: NDArray[np.uint8]
    means: NDArray[np.float32]
    mask: NDArray[np.uint8] | None = None
    outside: str = ""
    light: Light | None = None

    @classmethod
    def from_pixels(
        cls,
        camera: Camera,
        pixels: NDArray[np.uint8],
        mask: NDArray[np.uint8] | None = None,
        outside: str = "",
        light: Light | None = None,
    ) -> Level:
        """A level with pixels [H, W, 3]."""
        planar = np.ascontiguousarray(pixels.transpose(2, 0, 1))
        return cls(camera, planar, channel_means(planar), mask, outside, light)

    @property
    def plain(self) -> bool:
        """Whether the pixels are the target of a render without changes."""
        return self.mask is None and self.light is None


@dataclass(frozen=True)
class TrainingView:
    """A training view at each of RESOLUTIONS."""

    name: str
    levels: Sequence[Level]

    def prefetch(self, level: int) -> None:
        """Announce that a level is needed soon."""
        if isinstance(self.levels, _Stored):
            self.levels.prefetch(level)


class _Stored(Sequence[Level]):
    """Levels whose pixels and masks are stored in an album, in the order of their addition."""

    def __init__(self, album: Album) -> None:
        self._album = album
        self._known: list[tuple[Level, int, int | None]] = []

    def add(self, level: Level) -> None:
        mask = None if level.mask is None else self._album.add(level.mask)
        bare = replace(level, pixels=np.zeros((3, 0, 0), np.uint8), mask=None)
        self._known.append((bare, self._album.add(level.pixels), mask))

    def prefetch(self, level: int) -> None:
        self._album.expect(self._known[level][1])

    def __len__(self) -> int:
        return len(self._known)

    @overload
    def __getitem__(self, level: int) -> Level: ...
    @overload
    def __getitem__(self, level: slice) -> Sequence[Level]: ...
    def __getitem__(self, level: int | slice) -> Level | Sequence[Level]:
        if isinstance(level, slice):
            return [self[i] for i in range(len(self))[level]]
        bare, number, masked = self._known[level]
        mask = None if masked is None else self._album.picture(masked)
        return replace(bare, pixels=self._album.picture(number), mask=mask)


def load_views(
    folder: Path, views: Iterable[View], train_side: int, work: Path, light: bool = False
) -> list[TrainingView]:
    """The training views at their resolutions.

    Args:
        folder: of the undistorted images.
        views: to load.
        train_side: largest length of the longer side at full resolution, pixels.
        work: folder for a file with all pixels, which is mapped into memory.
        light: whether to correct exposure and white balance.

    Raises SplatError, and OSError if the disk is full.
    """
    loaded = []
    with Album(work) as album:
        for view in views:
            levels = _Stored(album)
            for _, scale in RESOLUTIONS:
                camera = view.camera.fitted(max(16, round(train_side * scale)))
                photograph = load_evaluation_view(folder, view, camera)
                masked = photograph.mask, view.outside
                kept_light = view.light if light else None
                levels.add(Level.from_pixels(camera, photograph.pixels, *masked, kept_light))
            loaded.append(TrainingView(view.name, levels))
    return loaded
