"""The backends, in one list, and the choice among them.

A new backend is one module and one line here: a class as `definition.Rasteriser` describes it. If
it also wants a training step of its own, with parameters and moments where its kernels are, it
names that class too (`training.step.TrainingStep`); else training makes do with forward and
backward. What this list names is imported when it is first used.

A backend that runs on several devices of torch is asked for with the one it is to run on:
"reference@cuda".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from stages.base.errors import Family, SplatError
from stages.base.lazy import load_object
from stages.raster.torch_device import CPU, DEVICES

if TYPE_CHECKING:
    from stages.base.stage import Report
    from stages.raster.definition import Rasteriser

AUTO = "auto"
_AT = "@"


@dataclass(frozen=True)
class Backend:
    """rasteriser, step: "module:Class". what: for help, a few words. obstacle: "module:function"
    that says why "auto" passes it over here, "" where it does not; none for one that always runs.
    told: "module:function" that says what it runs on; none for the processor. devices: of torch, if
    it is to be told one: its class takes the name, and so does `told`; on: the one asked for.
    """

    name: str
    rasteriser: str
    what: str
    step: str = "stages.training.reference_step:ReferenceStep"
    obstacle: str = ""
    told: str = ""
    devices: tuple[str, ...] = ()
    on: str = CPU

    def where(self) -> str:
        """What it runs on, for a manifest."""
        return str(load_object(self.told)(*self._device())) if self.told else CPU

    def made(self) -> Rasteriser:
        """A new rasteriser. Raises SplatError where what it runs on is not there."""
        found: Rasteriser = load_object(self.rasteriser)(*self._device())
        return found

    def require(self) -> None:
        """Raises SplatError where what it runs on is not there; asks no more than that takes."""
        if self.obstacle or self.on != CPU:
            self.made()

    def _device(self) -> tuple[str, ...]:
        return (self.on,) if self.devices else ()

    def why_not(self) -> str:
        """Why "auto" passes it over here; "" where it does not."""
        return str(load_object(self.obstacle)()) if self.obstacle else ""


# "auto" takes the first that nothing stands against.
BACKENDS = (
    Backend(
        "gpu",
        "stages.raster.gpu.rasteriser:GpuRasteriser",
        "Triton kernels",
        step="stages.training.gpu_step:GpuStep",
        obstacle="stages.raster.gpu.device:why_unavailable",
        told="stages.raster.gpu.device:describe",
    ),
    Backend(
        "cpu",
        "stages.raster.cpu.rasteriser:CpuRasteriser",
        "compiled kernels",
        step="stages.training.cpu_step:CpuStep",
    ),
    Backend(
        "reference",
        "stages.raster.reference_rasteriser:ReferenceRasteriser",
        "torch, slow",
        told="stages.raster.torch_device:describe",
        devices=DEVICES,
    ),
)
CHOICES = (AUTO, *(backend.name for backend in BACKENDS))


def backend_of(name: str) -> Backend:
    """The backend of that name, or the one that "auto" takes. Raises ValueError for another."""
    wanted, _, on = name.partition(_AT)
    for backend in BACKENDS:
        if backend.name == wanted or (wanted == AUTO and not backend.why_not()):
            if on and on not in backend.devices:
                break
            return replace(backend, on=on or CPU)
    raise ValueError(f"backend {name!r}, wanted one of {', '.join(CHOICES)}")


def unavailable_backends(name: str) -> dict[str, str]:
    """Why "auto" did not take the backends before the one that it takes; {} for another name."""
    chosen = [b.name for b in BACKENDS].index(backend_of(name).name) if name == AUTO else 0
    return {backend.name: backend.why_not() for backend in BACKENDS[:chosen]}


def rasteriser_of(name: str) -> Rasteriser:
    """A rasteriser of the backend `name` or "auto". Raises ValueError for an unknown one, and
    SplatError where what it runs on is not there."""
    return backend_of(name).made()


def runs_here(name: str) -> bool:
    """Whether the backend `name` can draw on this machine."""
    try:
        backend_of(name).require()
    except SplatError:
        return False
    return True


def qualified_name(backend: str, device: str = CPU) -> str:
    """What the options --backend and --device ask for together, in one word. Raises SplatError
    (option-device) for a device of a backend that takes none."""
    if device == CPU:
        return backend
    able = [each.name for each in BACKENDS if device in each.devices]
    if backend in able:
        return f"{backend}{_AT}{device}"
    raise SplatError(
        "option-device",
        given=f"--device {device} with --backend {backend}, which knows itself what it runs on.",
        wanted=f"--device goes with --backend {' or '.join(able)}.",
        hint=f"Add --backend {able[0]}, or leave --device away (--device {CPU} where a run "
        "remembers another).",
        family=Family.USAGE,
    )


def backend_of_settings(settings: Any) -> str:
    """What a stage's settings ask to draw with. Raises SplatError (option-device)."""
    return qualified_name(settings.backend, settings.device)


def report_backend(report: Report, name: str) -> None:
    """Into a stage's report: which backend the name stands for here, and what it runs on."""
    chosen = backend_of(name)
    report.metric("backend", chosen.name)
    report.device = chosen.where()


def backend_setting() -> Any:
    """The `backend` field of a stage's settings: one checked choice everywhere."""
    words = ", ".join(f"{backend.name} ({backend.what})" for backend in BACKENDS)
    help = f"What draws: {AUTO} (the fastest), {words}."
    return field(default=AUTO, metadata={"help": help, "choices": CHOICES, "midway": True})


def device_setting() -> Any:
    """The `device` field beside it."""
    help = f"What --backend reference runs on, as torch names it: {', '.join(DEVICES)}."
    return field(default=CPU, metadata={"help": help, "choices": DEVICES, "midway": True})
