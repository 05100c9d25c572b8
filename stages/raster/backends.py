"""The list of rendering backends, and the choice among them.

To add a backend: write a class with the methods of `definition.Rasteriser` and add one row to
`BACKENDS`. A backend that also has training kernels gets a row in `train.steps.step`; the others
train through `forward` and `backward`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stages.base.errors import SplatError
from stages.base.settings import setting

if TYPE_CHECKING:
    from stages.base.stage import Report
    from stages.raster.definition import Rasteriser  # loads torch, the list does not

AUTO = "auto"
CPU = "cpu"  # what a manifest calls the hardware of a backend without a description


@dataclass(frozen=True)
class Backend:
    """One row of the list.

    Args:
        name: as given to --backend.
        create: makes a new rasteriser. Raises SplatError if the hardware that it needs is absent.
        summary: a few words for the help text.
        why_unavailable: why "auto" must skip the backend on this machine; "" if it may take it.
        describe: the hardware that it runs on, for a manifest. Raises as `create`.
        needs_hardware: whether it runs on some machines only.
    """

    name: str
    create: Callable[[], Rasteriser]
    summary: str
    why_unavailable: Callable[[], str] = str
    describe: Callable[[], str] = lambda: CPU
    needs_hardware: bool = False

    def require(self) -> None:
        """Raises SplatError if the hardware that it needs is absent."""
        if self.needs_hardware:
            self.create()


def _gpu() -> Rasteriser:
    from stages.raster.gpu.rasteriser import GpuRasteriser  # loads torch, the list does not

    return GpuRasteriser()


def _why_no_gpu() -> str:
    from stages.raster.gpu import device  # loads torch, the list does not

    return device.why_unavailable()


def _gpu_description() -> str:
    from stages.raster.gpu import device  # loads torch, the list does not

    return device.describe()


def _webgpu() -> Rasteriser:
    from stages.raster.webgpu.rasteriser import WebGpuRasteriser  # loads wgpu, the list does not

    return WebGpuRasteriser()


def _why_no_webgpu() -> str:
    from stages.raster.webgpu import device  # loads wgpu, the list does not

    return device.why_unavailable()


def _webgpu_description() -> str:
    from stages.raster.webgpu import device  # loads wgpu, the list does not

    return device.describe()


def _cpu() -> Rasteriser:
    from stages.raster.cpu.rasteriser import CpuRasteriser  # loads torch, the list does not

    return CpuRasteriser()


def _reference() -> Rasteriser:
    # loads torch, the list does not
    from stages.raster.reference_rasteriser import ReferenceRasteriser

    return ReferenceRasteriser()


# "auto" takes the first that is available.
BACKENDS = (
    Backend("gpu", _gpu, "Triton kernels", _why_no_gpu, _gpu_description, needs_hardware=True),
    Backend(
        *("webgpu", _webgpu, "Vulkan, Metal or Direct3D", _why_no_webgpu, _webgpu_description),
        needs_hardware=True,
    ),
    Backend("cpu", _cpu, "compiled kernels"),
    Backend("reference", _reference, "torch, slow"),
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
