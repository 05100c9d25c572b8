"""A training step that continues with fewer splats if a device's memory is full."""

from __future__ import annotations

from collections.abc import Callable
from typing import SupportsInt, TypeVar

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import MemoryFull, RasterSettings
from stages.scene import Camera
from stages.train.cap import most_opaque
from stages.train.optimiser import Model
from stages.train.steps.step import StepInput, TrainingStep

Made = TypeVar("Made")


class MemoryLimitedStep:
    """See `step.TrainingStep`. Raises MemoryFull if no splat fits.

    Args:
        inner: the training step of the device.
        full: is called with the number of splats that fit whenever it falls.
    """

    def __init__(self, inner: TrainingStep, full: Callable[[int], None]) -> None:
        self.inner, self._full = inner, full

    def __len__(self) -> int:
        return len(self.inner)

    @property
    def skipped(self) -> SupportsInt:
        """See `step.TrainingStep`."""
        return self.inner.skipped

    def load(self, model: Model) -> None:
        """See `step.TrainingStep`; loads the most opaque splats that fit."""
        while True:
            try:
                return self.inner.load(model)
            except MemoryFull as full:
                fits = self._lowered(full, len(model))
            model = most_opaque(self.inner.model(), fits)

    def model(self) -> Model:
        """See `step.TrainingStep`."""
        return self.inner.model()

    def forget_views(self) -> None:
        """See `step.TrainingStep`."""
        self.inner.forget_views()

    def step(self, given: StepInput) -> float:
        """See `step.TrainingStep`."""
        return self._done(lambda: self.inner.step(given))

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """See `step.TrainingStep`."""
        return self._done(lambda: self.inner.draw(camera, settings, smooth))

    def _done(self, work: Callable[[], Made]) -> Made:
        while True:
            try:
                return work()
            except MemoryFull as full:
                fits = self._lowered(full, len(self))
            # here, because the error holds what the work had allocated
            self.load(most_opaque(self.inner.model(), fits))

    def _lowered(self, full: MemoryFull, splats: int) -> int:
        """How many of the splats fit, which is reported; raises `full` if that is none or all."""
        if not 0 < full.fits < splats:
            raise full
        self._full(full.fits)
        return full.fits
