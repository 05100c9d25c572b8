"""The list of rendering backends, and the choice among them.

To add a backend: write a class with the methods of `definition.Rasteriser` and add one row to
`BACKENDS`. A backend that also has training kernels gets a row in `train.steps.step`; the others
train through `forward` and `backward`. Modules named in the list are imported at first use.
"""

from __future__ import annotations

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from stages.base.errors import SplatError
from stages.base.settings import setting

if TYPE_CHECKING:
    from stages.base.stage import Report
    from stages.raster.definition import Rasteriser

AUTO = "auto"
CPU = "cpu"  # what a manifest calls the hardware of a backend without a description


@dataclass(frozen=True)
class Backend:
    """One row of the list.

    Functions and classes are named as "module:attribute".

    Args:
        name: as given to --backend.
        rasteriser: the class that draws.
        summary: a few words for the help text.
        availability: function that returns why "auto" must skip the backend on this machine, or ""
            if it can be used. Empty for a backend that always runs.
        description: function that describes the hardware; empty for the CPU.
    """

    name: str
    rasteriser: str
    summary: str
    availability: str = ""
    description: str = ""

    def describe(self) -> str:
        """The hardware that it runs on, for a manifest. Raises SplatError where it is absent."""
        return str(resolve_name(self.description)()) if self.description else CPU

    def create(self) -> Rasteriser:
        """A new rasteriser. Raises SplatError if the hardware that it needs is absent."""
        rasteriser: Rasteriser = resolve_name(self.rasteriser)()
        return rasteriser

    def require(self) -> None:
        """Raises SplatError if the hardware that it needs is absent. Imports no more than that
        check needs."""
        if self.availability:
            self.create()

    def why_unavailable(self) -> str:
        """Why "auto" does not choose it on this machine; "" if it may."""
        return str(resolve_name(self.availability)()) if self.availability else ""


# "auto" takes the first that is available.
BACKENDS = (
    Backend(
        "gpu",
        "stages.raster.gpu.rasteriser:GpuRasteriser",
        "Triton kernels",
        availability="stages.raster.gpu.device:why_unavailable",
        description="stages.raster.gpu.device:describe",
    ),
    Backend("cpu", "stages.raster.cpu.rasteriser:CpuRasteriser", "compiled kernels"),
    Backend(
        "reference",
        "stages.raster.reference_rasteriser:ReferenceRasteriser",
        "torch, slow",
    ),
)
CHOICES = (AUTO, *(backend.name for backend in BACKENDS))


def backend_of(name: str) -> Backend:
    """The backend of that name, or the one that "auto" takes. Raises ValueError for an unknown
    name."""
    for backend in BACKENDS:
        if backend.name == name or (name == AUTO and not backend.why_unavailable()):
            return backend
    raise ValueError(f"backend {name!r}, wanted one of {', '.join(CHOICES)}")


def unavailable_backends(name: str) -> dict[str, str]:
    """Why "auto" skipped each backend before the one that it takes; {} for any other name."""
    chosen = [b.name for b in BACKENDS].index(backend_of(name).name) if name == AUTO else 0
    return {backend.name: backend.why_unavailable() for backend in BACKENDS[:chosen]}


def rasteriser_of(name: str) -> Rasteriser:
    """A new rasteriser of the backend `name` or "auto".

    Raises ValueError for an unknown name, and SplatError if the hardware that it needs is absent.
    """
    return backend_of(name).create()


def runs_here(name: str) -> bool:
    """Whether the backend `name` can draw on this machine."""
    try:
        backend_of(name).require()
    except SplatError:
        return False
    return True


def report_backend(report: Report, name: str) -> None:
    """Record in a stage's report which backend `name` stands for here, and its hardware."""
    chosen = backend_of(name)
    report.metric("backend", chosen.name)
    report.device = chosen.describe()


def backend_setting() -> Any:
    """The field `backend` of a stage's settings."""
    choices = ", ".join(f"{backend.name} ({backend.summary})" for backend in BACKENDS)
    help = f"Rendering backend: {AUTO} (the fastest available), {choices}."
    return setting(AUTO, help, choices=CHOICES, midway=True, panel="Advanced")
