"""Functions that kernels call.

Triton compiles them as it does kernels. Its interpreter sets itself up at each call of what it
interprets, which takes longer than these functions do: there they are Python functions.
"""

from __future__ import annotations

from typing import Any

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

else:

    @triton.jit
    def sum_of(x, axis: tl.constexpr):
        return tl.sum(x, axis)

    @triton.jit
    def top_of(x, axis: tl.constexpr):
        return tl.max(x, axis)
