"""What one splat is made of and takes in memory, in numbers that anyone can check by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

SINGLE_BYTES, HALF_BYTES = 4, 2
# While it is trained, each number has its gradient and Adam's two moments beside it.
TRAINED_COPIES = 4
DEGREES = (0, 1, 2, 3)


def floats_of(degree: int) -> int:
    """Numbers of one splat: position 3, rotation 4, size 3, opacity 1, and 3 colours for each of
    (degree + 1)^2 spherical harmonics."""
    return 3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2


@dataclass(frozen=True)
class Memory:
    """Bytes of `count` splats of one degree: as float32, in half precision, while trained."""

    single: int
    half: int
    trained: int


def memory_of(degree: int, count: int = 1) -> Memory:
    numbers = floats_of(degree) * count
    single = SINGLE_BYTES * numbers
    return Memory(single, HALF_BYTES * numbers, TRAINED_COPIES * single)


def mass_within(sigmas: float) -> float:
    """The share of a drawn splat, a Gaussian in two dimensions, within so many standard
    deviations of its centre."""
    return 1.0 - math.exp(-0.5 * sigmas * sigmas)
