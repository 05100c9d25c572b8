"""The backends, in one list, and the choice among them.

A new backend is one module and one line here: a class as `definition.Rasteriser` describes it. If
it also wants a training step of its own, with parameters and moments where its kernels are, it
names that class too (`training.step.TrainingStep`); else training makes do with forward and
backward. What this list names is imported when it is first used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from stages.base.errors import SplatError
from stages.base.lazy import named

if TYPE_CHECKING:
    from stages.raster.definition import Rasteriser

AUTO = "auto"


@dataclass(frozen=True)
class Backend:
    """rasteriser, step: "module:Class". what: for help, a few words. obstacle: "module:function"
    that says why "auto" passes it over here, "" where it does not; none for one that always runs.
    device: "module:function" that says what it runs on; none for the processor.
    """

    name: str
    rasteriser: str
    what: str
    step: str = "stages.training.plain_step:PlainStep"
    obstacle: str = ""
    device: str = ""

    def where(self) -> str:
        """What it runs on, for a manifest."""
        return str(named(self.device)()) if self.device else "processor"

    def why_not(self) -> str:
        """Why "auto" passes it over here; "" where it does not."""
        return str(named(self.obstacle)()) if self.obstacle else ""


# "auto" takes the first that nothing stands against.
BACKENDS = (
    Backend(
        "gpu",
        "stages.raster.gpu.rasteriser:GpuRasteriser",
        "Triton kernels",
        step="stages.training.gpu_step:GpuStep",
        obstacle="stages.raster.gpu.device:obstacle",
        device="stages.raster.gpu.device:told",
    ),
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
    for backend in BACKENDS:
        if backend.name == name or (name == AUTO and not backend.why_not()):
            return backend
    raise ValueError(f"backend {name!r}, wanted one of {', '.join(CHOICES)}")


def passed_over(name: str) -> dict[str, str]:
    """Why "auto" did not take the backends before the one that it takes; {} for another name."""
    chosen = BACKENDS.index(backend_of(name)) if name == AUTO else 0
    return {backend.name: backend.why_not() for backend in BACKENDS[:chosen]}


def rasteriser_of(name: str) -> Rasteriser:
    """A rasteriser of the backend `name` or "auto". Raises ValueError for an unknown one."""
    made: Rasteriser = named(backend_of(name).rasteriser)()
    return made


def runs_here(name: str) -> bool:
    """Whether the backend `name` can draw on this machine."""
    try:
        return not backend_of(name).obstacle or bool(rasteriser_of(name))
    except SplatError:
        return False


def backend_setting() -> Any:
    """The `backend` field of a stage's settings: one checked choice everywhere."""
    words = ", ".join(f"{backend.name} ({backend.what})" for backend in BACKENDS)
    return field(
        default=AUTO,
        metadata={"help": f"What draws: {AUTO} (the fastest), {words}.", "choices": CHOICES},
    )
