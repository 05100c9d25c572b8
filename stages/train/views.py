"""The training views at every resolution of the schedule, and the image that a render of one is
compared with, where the view is masked or its light is corrected:

- Cut-out views: the photograph over the background of the render.
- Views with an ignored region: there the target equals the render, so it has no gradient.
- Corrected light: the photograph in the median exposure and white balance. A channel that was
  overexposed has a target of at least its corrected value, and a brighter render is no error.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.evaluation import load_evaluation_view
from stages.scene import IGNORE, TRANSPARENT, Camera, View
from stages.scene.light import BRIGHT, Light, gains_and_offsets
from stages.train.album import Album
from stages.train.loss import channel_means
from stages.train.schedule import SCALES

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Level:
    """A training view at one size.

    Args:
        camera: of that size.
        pixels: [3, H, W].
        means: [3] the mean of each channel, in 0..1.
        mask: [H, W], as in `scene.Photo`; None if all pixels count. See `train.views`.
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
    def unchanged(self) -> bool:
        """Whether the pixels are the target of a render without changes."""
        return self.mask is None and self.light is None


class Levels(Protocol):
    """A view at each of SCALES; the last has the full size."""

    def __getitem__(self, level: int, /) -> Level: ...


@dataclass(frozen=True)
class TrainingView:
    """A training view."""

    name: str
    levels: Levels

    def prefetch(self, level: int) -> None:
        """Announce that a level is needed soon."""
        if isinstance(self.levels, _Stored):
            self.levels.prefetch(level)


class _Stored:
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

    def __getitem__(self, level: int, /) -> Level:
        bare, number, masked = self._known[level]
        mask = None if masked is None else self._album.picture(masked)
        return replace(bare, pixels=self._album.picture(number), mask=mask)


def load_views(
    folder: Path,
    views: Iterable[View],
    train_side: int,
    work: Path,
    light: bool = False,
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
            full = view.camera.fitted(max(16, train_side))
            for scale in SCALES:
                camera = full.fitted(max(16, round(max(full.width, full.height) * scale)))
                photograph = load_evaluation_view(folder, view, camera)
                masked = photograph.mask, view.outside
                kept_light = view.light if light else None
                levels.add(Level.from_pixels(camera, photograph.pixels, *masked, kept_light))
            loaded.append(TrainingView(view.name, levels))
    return loaded


def target_of(
    level: Level, image: NDArray[np.float32], background: Colour
) -> NDArray[np.uint8] | NDArray[np.float32]:
    """[3, H, W] the target for `image` [>= 3, H, W], which was rendered over `background`: the
    photograph's bytes where nothing has to be done, else float32, mostly in 0..1."""
    if level.unchanged:
        return level.pixels
    pixels, overexposed, uncovered = evened(level)
    if overexposed is not None:
        pixels = np.where(overexposed, np.maximum(pixels, image[:3]), pixels)
    if uncovered is not None:
        return pixels + uncovered * np.array(background, np.float32)[:, None, None]
    return pixels if level.mask is None else np.where(level.mask > 0, pixels, image[:3])


def evened(level: Level) -> tuple[NDArray[Any], NDArray[np.bool_] | None, NDArray[Any] | None]:
    """(the photograph [3, H, W] in 0..1, in the median exposure and white balance if its light is
    corrected; [3, H, W] where it was overexposed before that, or None; [H, W] how much of the
    background shows if it is cut out, or None)."""
    pixels, overexposed = level.pixels * np.float32(1 / 255), None
    cut_out = level.mask if level.outside == TRANSPARENT else None
    solid = np.float32(1) if cut_out is None else cut_out * np.float32(1 / 255)
    if level.light is not None:
        gains, offsets = (row[:, None, None] for row in gains_and_offsets(level.light))
        overexposed = pixels >= BRIGHT
        pixels = (pixels - offsets * solid) / gains
    return pixels, overexposed, None if cut_out is None else np.asarray(1 - solid)


def ignore_masked(level: Level, v_image: NDArray[np.float32]) -> None:
    """Set the gradient [3, H, W] to 0 in the view's ignored region."""
    if level.mask is not None and level.outside == IGNORE:
        v_image[:, level.mask == 0] = 0.0
