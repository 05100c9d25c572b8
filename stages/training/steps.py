"""Which training step each rendering backend trains with."""

from __future__ import annotations

from stages.base.lazy import load_object
from stages.raster.backends import backend_of
from stages.training.step import TrainingStep

# A backend with training kernels of its own keeps parameters and moments where these are.
_OWN_STEPS = {
    "gpu": "stages.training.gpu_step:GpuStep",
    "cpu": "stages.training.cpu_step:CpuStep",
}
_OTHER_BACKENDS = "stages.training.reference_step:ReferenceStep"


def step_of(backend: str) -> TrainingStep:
    """A new training step of the backend `backend` or "auto". Raises ValueError for an unknown
    name, SplatError if the hardware that it needs is absent."""
    chosen = backend_of(backend)
    step_class = load_object(_OWN_STEPS.get(chosen.name, _OTHER_BACKENDS))
    step: TrainingStep = step_class(chosen.create())
    return step
