"""Parameters and memory of a splat, in figures that can be checked by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

SINGLE_BYTES, HALF_BYTES = 4, 2
# In training, each parameter has a gradient and two moments of Adam.
TRAINED_COPIES = 4
DEGREES = (0, 1, 2, 3)


def floats_of(degree: int) -> int:
    """Parameters of one splat: position 3, rotation 4, scale 3, opacity 1, and 3 colours for each
    of (degree + 1)^2 spherical harmonics."""
    return 3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2


@dataclass(frozen=True)
class Memory:
    """Bytes of some splats: as float32, in half precision, in training."""

    single: int
    half: int
    trained: int


def memory_of(degree: int, count: int = 1) -> Memory:
    """The memory of `count` splats of one SH degree."""
    numbers = floats_of(degree) * count
    single = SINGLE_BYTES * numbers
    return Memory(single, HALF_BYTES * numbers, TRAINED_COPIES * single)


def mass_within(sigmas: float) -> float:
    """The share of the mass of a two-dimensional Gaussian, as which a splat is drawn, within
    `sigmas` standard deviations of its centre."""
    return 1.0 - math.exp(-0.5 * sigmas * sigmas)
