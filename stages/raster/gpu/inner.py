"""Functions that kernels call.

Triton compiles them as it does kernels. Its interpreter sets itself up at each call of what it
interprets, which takes longer than these functions do: there they are Python functions.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl

from stages.raster.gpu.device import interpreted

INTERPRETED = interpreted()


def inner(function: Any) -> Any:
    """Decorates a function that kernels call."""
    return function if INTERPRETED else triton.jit(function)


if INTERPRETED:

    def sum_of(x: Any, axis: Any) -> Any:
        """Sum along an axis."""
        return tl.reduce(x, axis, tl.standard._sum_combine)

    def top_of(x: Any, axis: Any) -> Any:
        """Maximum along an axis."""
        return tl.reduce(x, axis, tl.standard._elementwise_max)

    def fused(x: Any, y: Any, z: Any) -> Any:
        """x y + z, rounded once, as devices do it; the interpreter's own rounds twice."""
        return (x.to(tl.float64) * y.to(tl.float64) + z).to(tl.float32)

else:

    @triton.jit
    def sum_of(x, axis: tl.constexpr):
        return tl.sum(x, axis)

    @triton.jit
    def top_of(x, axis: tl.constexpr):
        return tl.max(x, axis)

    @triton.jit
    def fused(x, y, z):
        return tl.fma(x, y, z)


@triton.jit
def trial_kernel(out):
    i = tl.arange(0, 32)
    tl.store(out + i, i * 0.5)


def trial() -> None:
    """Compile, launch and read a small kernel; raises whatever the machine raises."""
    out = torch.zeros(32, device="cpu" if INTERPRETED else "cuda")
    trial_kernel[(1,)](out)
    if out.sum().item() != 248.0:
        raise RuntimeError("its result is wrong")
