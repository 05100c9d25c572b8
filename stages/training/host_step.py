"""The part that all training steps share whose model is in NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import NO_SMOOTHING, Arrays, Rasteriser, RasterSettings
from stages.scene import Camera
from stages.training.dropout import INVISIBLE, Dropout
from stages.training.optimiser import Model, empty_model


class HostStep:
    """See `step.TrainingStep`; subclasses add `step`."""

    skipped = 0

    def __init__(self, rasteriser: Rasteriser) -> None:
        self.rasteriser = rasteriser
        self._model = empty_model()

    def __len__(self) -> int:
        return len(self._model)

    def load(self, model: Model) -> None:
        self._model = model

    def model(self) -> Model:
        return self._model

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        widths = self.widths(smooth)
        forward = self.rasteriser.forward(self._model.arrays, camera, settings, widths)
        return np.ascontiguousarray(forward.image[:3].transpose(1, 2, 0))

    def widths(self, smooth: bool) -> NDArray[np.float32]:
        """[N] of the smoothing filter, or [0] for none."""
        return self._model.smoothing if smooth else NO_SMOOTHING

    def arrays(self, dropout: Dropout | None) -> Arrays:
        """The model's arrays, with dropped splats made invisible."""
        arrays = self._model.arrays
        if dropout is None:
            return arrays
        dropped = dropout.dropped(self._model.gradient_count)
        logits = np.where(dropped, np.float32(INVISIBLE), self._model.opacity_logits)
        return (*arrays[:3], logits, arrays[4])
