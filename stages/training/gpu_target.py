"""A training view on the GPU and its target (see `target`), without transfers to the host."""

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
    """A training view on a device.

    Args:
        level: the view; kept because `gpu_step` identifies views by its means.
        pixels: [3, H, W] bytes, or float32 if the light is corrected or the view is cut out.
        means: [3] of the channels.
        uncovered: [H, W] how much of the background shows in a cut-out view.
        ignored: [H, W] where the render is not compared.
        bright: [3, H, W] where the view is overexposed.
        cameras: on the device, by the settings that they depend on.
    """

    level: Level
    pixels: Tensor
    means: Tensor
    uncovered: Tensor | None = None
    ignored: Tensor | None = None
    bright: Tensor | None = None
    cameras: dict[Any, View] = field(default_factory=dict)

    def view(self, rasteriser: GpuRasteriser, settings: RasterSettings) -> View:
        """The view's camera, which is sent to the device once for each value of these settings."""
        key = settings.near, settings.dilation_px2, settings.antialias
        if key not in self.cameras:
            self.cameras[key] = rasteriser.view(self.level.camera, settings)
        known = self.cameras[key]
        return View(known.cam, known.width, known.height, settings)

    def target(self, image: Tensor, background: Colour) -> tuple[Tensor, Tensor]:
        """(the target for `image` [>= 3, H, W], the means of its channels)."""
        if self.level.plain:
            return self.pixels, self.means
        target = self.pixels
        if self.bright is not None:
            target = torch.where(self.bright, torch.maximum(target, image[:3]), target)
        if self.uncovered is not None:
            behind = [self.uncovered * channel for channel in background]
            target = target + torch.stack(behind)
        if self.ignored is not None:
            target = torch.where(self.ignored, image[:3], target)
        return target, target.mean((1, 2))

    def ignore_masked(self, v_image: Tensor) -> None:
        """Set the gradient [3, H, W] to 0 in the view's ignored region."""
        if self.ignored is not None:
            v_image.masked_fill_(self.ignored, 0.0)


def gpu_target_of(level: Level, device: torch.device) -> GpuTarget:
    """The view, on the device."""

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
