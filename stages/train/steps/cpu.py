"""A training step with the CPU kernels: forward pass, loss, backward pass, update."""

from __future__ import annotations

import numpy as np

from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.train.loss import image_loss
from stages.train.optimiser import apply_gradients, measure_curvature
from stages.train.steps.step import HostStep, StepInput
from stages.train.views import ignore_masked, target_of


class CpuStep(HostStep):
    """See `step.TrainingStep`."""

    rasteriser: CpuRasteriser

    def __init__(self, rasteriser: CpuRasteriser) -> None:
        super().__init__(rasteriser)
        self._v_image = np.empty(0, np.float32)

    def step(self, given: StepInput) -> float:
        level, settings, pool = given.level, given.settings, self.rasteriser.pool
        if self._v_image.shape != level.pixels.shape:
            self._v_image = np.empty(level.pixels.shape, np.float32)
        forward = self.rasteriser.forward(self.arrays(given), level.camera, settings)
        target = target_of(level, forward.image, settings.background)
        means = level.means if level.unchanged else None
        loss = image_loss(pool, forward.image, target, self._v_image, means=means)
        if given.weight != 1.0:
            self._v_image *= np.float32(given.weight)
        ignore_masked(level, self._v_image)
        if (signs := self.sign_picture(given)) is not None:
            derivatives = self.rasteriser.backward(forward, signs)
            measure_curvature(pool, self._model, derivatives, given.rates.extent)
        backward = self.rasteriser.backward(forward, self._v_image)
        if given.use_gradients is not None:
            given.use_gradients(self._model, backward)
        apply_gradients(
            *(pool, self._model, backward, (settings.sh_degree + 1) ** 2, given.rates),
            *(level.camera.width, level.camera.height, given.damping),
        )
        return loss.value
