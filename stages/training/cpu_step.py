"""A training step with the CPU kernels: forward pass, loss, backward pass and Adam."""

from __future__ import annotations

import numpy as np

from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings
from stages.training.dropout import Dropout
from stages.training.host_step import HostStep
from stages.training.loss import image_loss
from stages.training.optimiser import LearningRates, apply_gradients
from stages.training.target import ignore_masked, target_of
from stages.training.views import Level


class CpuStep(HostStep):
    """See `step.TrainingStep`."""

    rasteriser: CpuRasteriser

    def __init__(self, rasteriser: CpuRasteriser) -> None:
        super().__init__(rasteriser)
        self._v_image = np.empty(0, np.float32)

    def step(
        self,
        level: Level,
        settings: RasterSettings,
        rates: LearningRates,
        smooth: bool,
        dropout: Dropout | None = None,
    ) -> float:
        camera, model, arrays = level.camera, self._model, self.arrays(dropout)
        if self._v_image.shape != level.pixels.shape:
            self._v_image = np.empty(level.pixels.shape, np.float32)
        pool, widths = self.rasteriser.pool, self.widths(smooth)
        forward = self.rasteriser.forward(arrays, camera, settings, widths)
        target = target_of(level, forward.image, settings.background)
        means = level.means if level.plain else None
        loss = image_loss(pool, forward.image, target, self._v_image, means=means)
        ignore_masked(level, self._v_image)
        backward = self.rasteriser.backward(arrays, forward, self._v_image, widths)
        coefficients = (settings.sh_degree + 1) ** 2
        apply_gradients(pool, model, backward, coefficients, rates, camera.width, camera.height)
        return loss.value
