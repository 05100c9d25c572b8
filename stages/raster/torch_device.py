"""The torch devices that the reference backend draws on. Imports torch at first use."""

from __future__ import annotations

from typing import Any

from stages.base.errors import ResourceError

CPU = "cpu"
DEVICES = (CPU, "cuda", "mps", "xpu")


def is_there(name: str) -> bool:
    """Whether this build of torch finds that device on this machine."""
    import torch

    known = torch.backends if name == "mps" else torch
    return name == CPU or bool(getattr(known, name).is_available())


def device_named(name: str) -> Any:
    """The torch device. Raises SplatError (raster-no-device) if it is not available."""
    import torch

    if not is_there(name):
        raise ResourceError(
            "raster-no-device",
            given=f"--device {name}: torch {torch.__version__} finds no such device here.",
            wanted=f"A device that is available: {', '.join(filter(is_there, DEVICES))}.",
            hint="Choose that, or another backend. docs/guide/gpu.md says which build of torch "
            "brings which device.",
        )
    return torch.device(name)


def widest(device: Any) -> Any:
    """The dtype to compute in: float64, or float32 on a device that has no other."""
    import torch

    try:
        torch.ones(1, dtype=torch.float64, device=device).mul(2)
    except (TypeError, RuntimeError):
        return torch.float32
    return torch.float64


def describe(name: str) -> str:
    """The device's model and torch's version. Raises SplatError if it is not available."""
    import torch

    if name == CPU:
        return CPU
    device_named(name)
    made = getattr(torch, name)
    model = made.get_device_name() if hasattr(made, "get_device_name") else "Apple GPU"
    return f"{model}, torch {torch.__version__}"
