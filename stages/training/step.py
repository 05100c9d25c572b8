"""One training step, whatever does it: the seam between the trainer and a backend's kernels."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import Rasteriser, RasterSettings
from stages.scene import Camera
from stages.training.dropout import Dropout
from stages.training.optimiser import LearningRates, Model
from stages.training.views import Level


class TrainingStep(Protocol):
    """A backend's own training step. It holds the model, wherever its kernels want it."""

    def __init__(self, rasteriser: Rasteriser) -> None: ...

    def __len__(self) -> int:
        """How many splats it holds; asks no device."""

    def load(self, model: Model) -> None:
        """Take a model over, moments and all: at the start, and after it grew or shrank."""

    def model(self) -> Model:
        """What it has become, on the host; good until the next step."""

    def step(
        self,
        level: Level,
        settings: RasterSettings,
        rates: LearningRates,
        smooth: bool,
        dropout: Dropout | None = None,
    ) -> float:
        """Draw, compare with one photograph, move the splats; the loss before that (a device's may
        be that of a few steps ago). The bands of SH up to `settings.sh_degree` take part. smooth:
        under the model's smoothing widths. What a masked photograph asks: `training.target`.
        dropout: which splats sit this step out."""

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """[H, W, 3] of the model as it is; the caller's own."""
