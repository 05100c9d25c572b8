"""A backend's training step: its interface, the choice of one, and what steps on the host share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Protocol, SupportsInt

import numpy as np
from numpy.typing import NDArray

from stages.raster.backends import backend_of
from stages.raster.definition import Arrays, Backward, Rasteriser, RasterSettings
from stages.scene import Camera
from stages.train.dropout import INVISIBLE, Dropout
from stages.train.gauss_newton import GaussNewton, sign_picture
from stages.train.optimiser import LearningRates, Model, empty_model
from stages.train.views import Level, ignore_masked

# A backend with training kernels of its own keeps parameters and moments where these are.
_OWN_STEPS = {
    "gpu": "stages.train.steps.gpu:GpuStep",
    "webgpu": "stages.train.steps.webgpu:WebGpuStep",
    "cpu": "stages.train.steps.cpu:CpuStep",
}
_OTHER_BACKENDS = "stages.train.steps.reference:ReferenceStep"


@dataclass(frozen=True)
class StepInput:
    """What one step trains on.

    Args:
        level: the training view at one resolution; masks and light as in `train.views`.
        settings: of the rasteriser; SH coefficients up to `settings.sh_degree` are trained.
        rates: learning rates.
        smooth: whether to render with the model's smoothing widths.
        dropout: drops splats from this step; None for none.
        use_gradients: is called with the model and its gradients before the step changes the model;
            only steps on the host do this.
        weight: factor of all gradients, not of the loss that a step returns.
        gauss_newton: to move by the curvature; None to move as Adam.
    """

    level: Level
    settings: RasterSettings
    rates: LearningRates
    smooth: bool = False
    dropout: Dropout | None = None
    use_gradients: Callable[[Model, Backward], None] | None = None
    weight: float = 1.0
    gauss_newton: GaussNewton | None = None

    @property
    def damping(self) -> float:
        """Of `gauss_newton`; 0 to move as Adam."""
        return 0.0 if self.gauss_newton is None else self.gauss_newton.damping

    @property
    def sign_key(self) -> int | None:
        """The key of `gauss_newton`: None if the curvature is not measured in this step."""
        return None if self.gauss_newton is None else self.gauss_newton.key


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

    def forget_views(self) -> None:
        """Forget the training views, because parts of them are ignored from now on."""

    def step(self, given: StepInput) -> float:
        """Forward pass, loss, backward pass and one step of Adam or of `gauss_newton`.

        Returns the loss before the step; a device may return that of a few steps earlier.
        """

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """[H, W, 3] of the current model, in an array that the caller may keep."""


def step_of(backend: str) -> TrainingStep:
    """A new training step of the backend `backend` or "auto". Raises ValueError for an unknown
    name, SplatError if the hardware that it needs is absent."""
    chosen = backend_of(backend)
    step_class = resolve_name(_OWN_STEPS.get(chosen.name, _OTHER_BACKENDS))
    step: TrainingStep = step_class(chosen.create())
    return step


class HostStep:
    """A `TrainingStep` whose model is in NumPy arrays; subclasses add `step`."""

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

    def forget_views(self) -> None:
        """See `TrainingStep`; a step on the host keeps none."""

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        forward = self.rasteriser.forward(self._model.drawn(smooth), camera, settings)
        return np.ascontiguousarray(forward.image[:3].transpose(1, 2, 0))

    def arrays(self, given: StepInput) -> Arrays:
        """The model's arrays, with dropped splats made invisible."""
        arrays = self._model.drawn(given.smooth)
        if given.dropout is None:
            return arrays
        dropped = given.dropout.dropped(self._model.gradient_count)
        logits = np.where(dropped, np.float32(INVISIBLE), self._model.opacity_logits)
        return (*arrays[:3], logits, *arrays[4:])

    @staticmethod
    def sign_picture(given: StepInput) -> NDArray[np.float32] | None:
        """[3, H, W] what a backward pass measures the curvature with; None if it is not measured in
        this step."""
        if given.sign_key is None:
            return None
        picture = sign_picture(given.level.pixels.shape, given.sign_key, given.weight)
        ignore_masked(given.level, picture)
        return picture
