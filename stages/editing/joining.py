"""Two scenes in one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.blocks import reported_blocks
from stages.scene import Splats

_FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")


def joined(first: Splats, second: Splats) -> Splats:
    """Both, in the frame and with the look of `first`, the higher SH degree for all; each splat
    keeps its own. Where both know an origin, they meet in the coordinates of the capture."""
    width = max(first.sh.shape[1], second.sh.shape[1])
    count = len(first) + len(second)
    shift = second.origin - first.origin
    parts = (first, np.zeros(3)), (second, shift)
    arrays: dict[str, Any] = {n: _empty(first, n, count, width) for n in _FIELDS}
    start = 0
    for part, offset in parts:
        for rows in reported_blocks(len(part)):
            there = slice(start + rows.start, start + rows.stop)
            for name in _FIELDS:
                values = getattr(part, name)[rows]
                if name == "sh":
                    arrays[name][there, : values.shape[1]] = values
                    arrays[name][there, values.shape[1] :] = 0
                else:
                    arrays[name][there] = values + offset if name == "means" else values
        start += len(part)
    return replace(first, **arrays)


def _empty(like: Splats, name: str, count: int, width: int) -> NDArray[Any]:
    values = getattr(like, name)
    shape = (count, width, 3) if name == "sh" else (count, *values.shape[1:])
    return scratch.empty(shape, values.dtype)
