"""The interface between the trainer and a backend's training step."""

from __future__ import annotations

from typing import Protocol, SupportsInt

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import Rasteriser, RasterSettings
from stages.scene import Camera
from stages.training.dropout import Dropout
from stages.training.optimiser import LearningRates, Model
from stages.training.views import Level


class TrainingStep(Protocol):
    """A backend's training step. It holds the model where the backend's kernels need it."""

    def __init__(self, rasteriser: Rasteriser) -> None: ...

    def __len__(self) -> int:
        """Number of splats; needs no transfer from a device."""

    @property
    def skipped(self) -> SupportsInt:
        """Number of steps so far that changed nothing, because a device's lists were full."""

    def load(self, model: Model) -> None:
        """Replace the model, including the optimiser's moments."""

    def model(self) -> Model:
        """The current model, on the host; good until the next step."""

    def step(
        self,
        level: Level,
        settings: RasterSettings,
        rates: LearningRates,
        smooth: bool,
        dropout: Dropout | None = None,
    ) -> float:
        """Forward pass, loss, backward pass and one step of Adam.

        Args:
            level: the training view at one resolution; masks and light as in `training.target`.
            settings: of the rasteriser; SH coefficients up to `settings.sh_degree` are trained.
            rates: learning rates.
            smooth: whether to render with the model's smoothing widths.
            dropout: drops splats from this step; None for none.

        Returns the loss before the step; a device may return that of a few steps earlier.
        """

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """[H, W, 3] of the current model, in an array that the caller may keep."""
