"""The device of the Triton kernels: a GPU, or for tests Triton's interpreter (TRITON_INTERPRET=1).

torch and Triton are imported inside functions, at first use: they take a second, and machines
without a GPU do not need them.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from stages.base.errors import ResourceError
from stages.base.text import size
from stages.raster.definition import MemoryFull

INSTALL = "docs/guide/gpu.md says which build of torch to install."
BYTES_A_SPLAT = 1700  # of training and densification, degree 3: docs/experiments/gpu.md
_DRIVERS = {"13": "580", "12": "525"}  # the oldest of NVIDIA's for a major version of CUDA
_FAST_FLOAT64 = ((8, 0), (9, 0), (10, 0))  # compute capabilities
_NVIDIA, _AMD = Path("/proc/driver/nvidia/version"), Path("/dev/kfd")  # there with their drivers
_COMPILERS = ("gcc", "clang")  # that Triton looks for
_FAULTS = ("CUDA error", "HIP error", "Triton Error")


def interpreted() -> bool:
    """Whether Triton's kernels are interpreted: thousands of times slower."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def why_unavailable() -> str:
    """Why "auto" does not choose this backend on this machine; "" if it does."""
    return "Triton's interpreter is on, for tests" if interpreted() else missing()


def missing() -> str:
    """Why the kernels cannot use a GPU; "" if they can."""
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    import torch

    if torch.version.cuda is None and torch.version.hip is None:
        return f"torch {torch.__version__} is built for the CPU alone"
    if not torch.cuda.is_available():
        return _unseen(torch.version.cuda)
    try:
        unserved = _unserved() if torch.version.cuda else ""
    except RuntimeError as error:  # another program may use it exclusively
        return f"the GPU does not answer: {_first_line(error)}"
    return unserved or _no_compiler() or _trial()


def _unserved() -> str:
    """Why torch's build does not run on this NVIDIA card; "" if it does."""
    import torch

    major, minor = torch.cuda.get_device_capability()
    built_for = torch.cuda.get_arch_list()
    served = [re.fullmatch(r"(sm|compute)_(\d+)(\d)[af]?", name) for name in built_for]
    for kind, *digits in (found.groups() for found in served if found):
        architecture = tuple(map(int, digits))
        # machine code runs within a generation, PTX on every later one
        if architecture <= (major, minor) and (kind == "compute" or architecture[0] == major):
            return ""
    if not built_for:
        return ""  # torch does not know
    card = f"{torch.cuda.get_device_name()} (sm_{major}{minor})"
    return f"{card} is too old for torch {torch.__version__}, or too new: {', '.join(built_for)}"


def _no_compiler() -> str:
    """Why Triton cannot build the launcher of its kernels, for which it needs C; "" if it can."""
    if os.name == "nt":
        return ""  # triton-windows brings a compiler
    named = os.environ.get("CC")
    if not any(map(shutil.which, (named,) if named else _COMPILERS)):
        what = f"CC names {named}, which is not there" if named else "neither gcc nor clang found"
        return f"{what}: Triton needs a C compiler once to launch its kernels"
    scheme = sysconfig.get_default_scheme().replace("posix_local", "posix_prefix")
    headers = Path(sysconfig.get_paths(scheme)["include"])
    if not (headers / "Python.h").exists():
        return f"no Python.h in {headers}, which Triton needs once: install python3-dev"
    return ""


@functools.cache
def _trial() -> str:
    """What a small kernel fails with here; "" if it runs. Once in a process."""
    try:
        resolve_name("stages.raster.gpu.inner:trial")()
    except Exception as error:  # a compiler, a driver or a card may fail in any way
        return f"a first kernel failed: {type(error).__name__}: {_first_line(error)}"
    return ""


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0]


def _unseen(cuda: str | None) -> str:
    """Why torch built for CUDA (or for ROCm if None) finds no card, as far as can be known."""
    nvidia, amd = _NVIDIA.exists(), _AMD.exists()
    if cuda and nvidia:
        oldest = _DRIVERS.get(cuda.partition(".")[0], "a newer one")
        return (
            f"NVIDIA's driver {_driver()} is too old for CUDA {cuda}, or shows no card to it "
            f"(it needs {oldest} or newer, or a torch built for an older CUDA)"
        )
    if cuda and amd:
        return "an AMD card is here, and torch is built for NVIDIA's (CUDA)"
    if not cuda and nvidia:
        return "an NVIDIA card is here, and torch is built for AMD's (ROCm)"
    return "no GPU found that this build of torch can use"


def _driver() -> str:
    """Version of NVIDIA's driver; "" if unknown."""
    try:
        found = re.search(r"\b\d+\.\d+(\.\d+)?\b", _NVIDIA.read_text())
    except OSError:
        found = None
    return found[0] if found else ""


def require() -> Any:
    """The torch device to run on. Raises SplatError if there is none."""
    fault = missing() if not interpreted() else _no_triton()
    if fault:
        raise ResourceError(
            "raster-no-gpu",
            given=f"The backend gpu cannot run here: {fault}.",
            wanted="It takes Linux or Windows, an NVIDIA or AMD card, and a torch built for it.",
            hint=f"Choose --backend cpu. {INSTALL}",
        )
    import torch

    return torch.device("cpu" if interpreted() else "cuda")


def _no_triton() -> str:
    return "" if importlib.util.find_spec("triton") else "Triton is not installed"


def describe() -> str:
    """Card, memory, and versions of driver, torch and Triton, in one line."""
    import torch

    if interpreted():
        return f"Triton's interpreter on the CPU, {built()}"
    properties = torch.cuda.get_device_properties(0)
    runtime = torch.version.hip or torch.version.cuda
    kind = "ROCm" if torch.version.hip else "CUDA"
    driver = f"driver {_driver()}, " if _driver() else ""
    real = "" if float64_is_fast() else ", float32 footprints"
    name = f"{properties.name}, {size(properties.total_memory)}"
    return f"{name}, {driver}{kind} {runtime}, {built()}{real}"


def float64_is_fast() -> bool:
    """Whether the card has float64 units for at least a sixteenth of its float32 ones: NVIDIA's for
    data centres up to the B200, AMD's of the Instinct line. Others have a sixty-fourth."""
    import torch

    if interpreted():
        return True
    if torch.version.hip:
        return bool(torch.cuda.get_device_properties(0).gcnArchName.startswith("gfx9"))
    return torch.cuda.get_device_capability() in _FAST_FLOAT64


def built() -> str:
    """Versions of torch and Triton."""
    import torch

    if importlib.util.find_spec("triton") is None:
        return f"torch {torch.__version__}, no Triton"
    import triton

    return f"torch {torch.__version__}, Triton {triton.__version__}"


@contextmanager
def gpu_errors_explained(splats: int) -> Iterator[None]:
    """Turn errors of the device, while it works on so many splats, into SplatError."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        free, total = torch.cuda.mem_get_info() if torch.cuda.is_available() else (0, 0)
        held = torch.cuda.memory_reserved() if torch.cuda.is_available() else 0
        raise out_of_memory(splats, free, held, total) from error
    except Exception as error:
        if not _is_of_device(error):
            raise
        raise ResourceError(
            "raster-gpu-failed",
            given=f"The GPU stopped: {_first_line(error)}.",
            wanted="A GPU that answers; another program may use it exclusively.",
            hint="Run `splat doctor`, see nvidia-smi or rocm-smi, or choose --backend cpu.",
        ) from error


def _is_of_device(error: Exception) -> bool:
    """Whether a card, its driver or a compiler failed, and not this program."""
    kind = type(error)
    compiling = kind.__module__.startswith("triton.") and kind.__name__ != "InterpreterError"
    launcher = isinstance(error, subprocess.CalledProcessError)
    return compiling or launcher or any(fault in str(error) for fault in _FAULTS)


def out_of_memory(splats: int, free: int, held: int, total: int) -> MemoryFull:
    """The error for splats that did not fit. Bytes: free, held by this process, total."""
    fits = splats // 2
    if total:
        fits = min(int(0.8 * splats), int(0.9 * (free + held) / BYTES_A_SPLAT))
    room = f"{size(free)} of {size(total)} free, {size(held)} held by this run"
    return MemoryFull(splats, fits, room)
