"""A training step by the CPU kernels: drawing, loss, the way back and Adam, nothing allocated."""

from __future__ import annotations

import numpy as np

from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings
from stages.training.host_step import HostStep
from stages.training.loss import image_loss
from stages.training.optimiser import LearningRates, apply_gradients
from stages.training.views import Level


class CpuStep(HostStep):
    """See `step.TrainingStep`."""

    rasteriser: CpuRasteriser

    def __init__(self, rasteriser: CpuRasteriser) -> None:
        super().__init__(rasteriser)
        self._v_image = np.empty(0, np.float32)

    def step(
        self, level: Level, settings: RasterSettings, rates: LearningRates, smooth: bool
    ) -> float:
        camera, target, model = level.camera, level.pixels, self._model
        if self._v_image.shape != target.shape:
            self._v_image = np.empty(target.shape, np.float32)
        pool, widths = self.rasteriser.pool, self.widths(smooth)
        forward = self.rasteriser.forward(model.arrays, camera, settings, widths)
        loss = image_loss(pool, forward.image, target, self._v_image, means=level.means)
        backward = self.rasteriser.backward(model.arrays, forward, self._v_image, widths)
        bands = (settings.sh_degree + 1) ** 2
        apply_gradients(pool, model, backward, bands, rates, camera.width, camera.height)
        return loss.value
