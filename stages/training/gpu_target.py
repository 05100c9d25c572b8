"""A photograph on the GPU, and what it asks of its drawing, without a word to the host."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.raster.definition import RasterSettings
from stages.raster.gpu.rasteriser import GpuRasteriser, View
from stages.scene import IGNORE, TRANSPARENT
from stages.scene.light import BRIGHT, gains_and_offsets
from stages.training.target import Colour
from stages.training.views import Level


@dataclass
class GpuTarget:
    """pixels [3, H, W]: bytes, or where light was taken out of them or they are cut out float32.
    means [3]. uncovered [H, W]: how much of the background shows, where a photograph is cut out.
    ignored [H, W], bright [3, H, W]: where nothing is asked, and where no less than the value is.
    """

    level: Level  # kept: `gpu_step` knows photographs by its means
    pixels: Tensor
    means: Tensor
    uncovered: Tensor | None = None
    ignored: Tensor | None = None
    bright: Tensor | None = None
    cams: dict[Any, View] = field(default_factory=dict)

    def view(self, rasteriser: GpuRasteriser, settings: RasterSettings) -> View:
        """The photograph's camera; sent to the device once for what it holds of the settings."""
        key = settings.near, settings.dilation_px2, settings.antialias
        if key not in self.cams:
            self.cams[key] = rasteriser.view(self.level.camera, settings)
        known = self.cams[key]
        return View(known.cam, known.width, known.height, settings)

    def target(self, image: Tensor, background: Colour) -> tuple[Tensor, Tensor]:
        """(what `image` [>= 3, H, W] is to be compared with, its channels' means)."""
        if self.level.plain:
            return self.pixels, self.means
        asked = self.pixels
        if self.bright is not None:
            asked = torch.where(self.bright, torch.maximum(asked, image[:3]), asked)
        if self.uncovered is not None:
            behind = [self.uncovered * channel for channel in background]
            asked = asked + torch.stack(behind)
        if self.ignored is not None:
            asked = torch.where(self.ignored, image[:3], asked)
        return asked, asked.mean((1, 2))

    def forget_ignored(self, v_image: Tensor) -> None:
        """No gradient [3, H, W] where the photograph is to be ignored."""
        if self.ignored is not None:
            v_image.masked_fill_(self.ignored, 0.0)


def gpu_target_of(level: Level, device: torch.device) -> GpuTarget:
    """The photograph, on the device."""

    def sent(array: Any) -> Tensor:
        return torch.tensor(array, device=device)

    if level.plain:
        return GpuTarget(level, sent(level.pixels), sent(level.means))
    pixels, bright = level.pixels * np.float32(1 / 255), None
    cut_out = level.mask if level.outside == TRANSPARENT else None
    solid = np.float32(1) if cut_out is None else cut_out * np.float32(1 / 255)
    if level.light is not None:
        gains, offsets = (row[:, None, None] for row in gains_and_offsets(level.light))
        bright = sent(pixels >= BRIGHT)
        pixels = (pixels - offsets * solid) / gains
    uncovered = None if cut_out is None else sent(1 - solid)
    ignores = level.mask is not None and level.outside == IGNORE
    ignored = sent(level.mask == 0) if ignores else None
    return GpuTarget(level, sent(pixels), sent(level.means), uncovered, ignored, bright)
