"""The device of the Triton kernels: a GPU, or for tests Triton's interpreter (TRITON_INTERPRET=1).

torch and Triton are imported at first use.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stages.base.errors import ResourceError
from stages.raster.definition import MemoryFull

INSTALL = "docs/guide/gpu.md says which build of torch to install."
_OLDEST = (7, 0)  # compute capability that Triton compiles for
BYTES_A_SPLAT = 1500  # of training, with degree 3 and 4 tiles a splat: docs/experiments/gpu.md
_NVIDIA, _AMD = Path("/proc/driver/nvidia/version"), Path("/dev/kfd")  # there with their drivers
_COMPILERS = ("cc", "gcc", "clang")


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
        if torch.version.cuda and torch.cuda.get_device_capability() < _OLDEST:
            return f"{torch.cuda.get_device_name()} is too old for Triton"
    except RuntimeError as error:  # another program may use it exclusively
        return f"the GPU does not answer: {str(error).splitlines()[0]}"
    if not os.environ.get("CC") and not any(map(shutil.which, _COMPILERS)):
        return "no C compiler found, which Triton needs once to launch its kernels"
    return ""


def _unseen(cuda: str | None) -> str:
    """Why torch built for CUDA (or for ROCm if None) finds no card, as far as can be known."""
    nvidia, amd = _NVIDIA.exists(), _AMD.exists()
    if cuda and nvidia:
        return f"NVIDIA's driver {_driver()} is too old for CUDA {cuda}, or shows no card to it"
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
            wanted="It takes Linux, an NVIDIA or AMD card, and a torch built for it.",
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
    gib = properties.total_memory / 2**30
    driver = f"driver {_driver()}, " if _driver() else ""
    return f"{properties.name}, {gib:.0f} GiB, {driver}{kind} {runtime}, {built()}"


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
    except RuntimeError as error:
        if "CUDA error" not in str(error) and "HIP error" not in str(error):
            raise
        raise ResourceError(
            "raster-gpu-failed",
            given=f"The GPU stopped: {str(error).splitlines()[0]}.",
            wanted="A GPU that answers; another program may use it exclusively.",
            hint="Run `splat doctor`, see nvidia-smi or rocm-smi, or choose --backend cpu.",
        ) from error


def out_of_memory(splats: int, free: int, held: int, total: int) -> MemoryFull:
    """The error for splats that did not fit. Bytes: free, held by this process, total."""
    fits = splats // 2
    if total:
        fits = min(int(0.8 * splats), int(0.9 * (free + held) / BYTES_A_SPLAT))
    gib = 2**30
    room = f"{free / gib:.1f} of {total / gib:.1f} GiB free, {held / gib:.1f} GiB held by this run"
    return MemoryFull(splats, fits, room)
