"""The backends, in one list, and the choice among them.

A new backend is one module and one line here: a class as `definition.Rasteriser` describes it. If
it also wants a training step of its own, with parameters and moments where its kernels are, it
names that class too (`training.step.TrainingStep`); else training makes do with forward and
backward. What this list names is imported when it is first used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from stages.base.lazy import named

if TYPE_CHECKING:
    from stages.raster.definition import Rasteriser

AUTO = "auto"


@dataclass(frozen=True)
class Backend:
    """rasteriser, step: "module:Class". what: for help, a few words."""

    name: str
    rasteriser: str
    what: str
    step: str = "stages.training.plain_step:PlainStep"


# The first one is what "auto" takes.
BACKENDS = (
    Backend(
        "cpu",
        "stages.raster.cpu.rasteriser:CpuRasteriser",
        "compiled kernels",
        step="stages.training.cpu_step:CpuStep",
    ),
    Backend("reference", "stages.raster.reference_rasteriser:ReferenceRasteriser", "torch, slow"),
)
CHOICES = (AUTO, *(backend.name for backend in BACKENDS))


def backend_of(name: str) -> Backend:
    """The backend of that name, or the one that "auto" takes. Raises ValueError for another."""
    if name == AUTO:
        return BACKENDS[0]
    for backend in BACKENDS:
        if backend.name == name:
            return backend
    raise ValueError(f"backend {name!r}, wanted one of {', '.join(CHOICES)}")


def rasteriser_of(name: str) -> Rasteriser:
    """A rasteriser of the backend `name` or "auto". Raises ValueError for an unknown one."""
    made: Rasteriser = named(backend_of(name).rasteriser)()
    return made


def backend_setting() -> Any:
    """The `backend` field of a stage's settings: one checked choice everywhere."""
    words = ", ".join(f"{backend.name} ({backend.what})" for backend in BACKENDS)
    return field(
        default=AUTO,
        metadata={"help": f"What draws: {AUTO} (the fastest), {words}.", "choices": CHOICES},
    )
