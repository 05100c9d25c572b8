"""A training step that goes on with fewer splats where a device's memory is full."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import MemoryFull, RasterSettings
from stages.scene import Camera
from stages.training.cap import most_opaque
from stages.training.dropout import Dropout
from stages.training.optimiser import LearningRates, Model
from stages.training.step import TrainingStep
from stages.training.views import Level

Made = TypeVar("Made")


class MemoryLimitedStep:
    """See `step.TrainingStep`. inner: whose device it is. full: is told how many splats fit, each
    time that they have to get fewer. Raises MemoryFull where none would fit."""

    def __init__(self, inner: TrainingStep, full: Callable[[int], None]) -> None:
        self.inner, self._full = inner, full

    def __len__(self) -> int:
        return len(self.inner)

    def load(self, model: Model) -> None:
        """See `step.TrainingStep`; as much of the model as there is room for."""
        while (fits := self._refused(partial(self.inner.load, model), len(model))) is not None:
            model = most_opaque(model, fits)

    def model(self) -> Model:
        """See `step.TrainingStep`."""
        return self.inner.model()

    def step(
        self,
        level: Level,
        settings: RasterSettings,
        rates: LearningRates,
        smooth: bool,
        dropout: Dropout | None = None,
    ) -> float:
        """See `step.TrainingStep`."""
        return self._done(lambda: self.inner.step(level, settings, rates, smooth, dropout))

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """See `step.TrainingStep`."""
        return self._done(lambda: self.inner.draw(camera, settings, smooth))

    def _done(self, work: Callable[[], Made]) -> Made:
        found: list[Made] = []
        while (fits := self._refused(lambda: found.append(work()), len(self))) is not None:
            self.load(most_opaque(self.inner.model(), fits))
        return found[0]

    def _refused(self, work: Callable[[], None], splats: int) -> int | None:
        """How many of the splats fit, if the work did not; by then all that it held is let go."""
        try:
            work()
        except MemoryFull as full:
            if not 0 < full.fits < splats:
                raise
            fits = full.fits
        else:
            return None
        self._full(fits)
        return fits
