"""What a row of the extremes table gives: numbers with their bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from tests.scenes import BACKENDS, PARAMETERS


@dataclass(frozen=True)
class Measured:
    """One number of a row, for one backend.

    error: 0 is perfect; where a thing is right or wrong, how many are wrong. bound: None where the
    number is only reported. note: why this bound cannot be held, where it cannot.
    """

    row: int
    what: str
    error: float
    bound: float | None
    note: str = ""

    @property
    def passed(self) -> bool:
        return self.bound is None or self.error <= self.bound

    @property
    def accepted(self) -> bool:
        """Whether it passed, or is known not to and says why."""
        return self.passed or bool(self.note)


@dataclass(frozen=True)
class Row:
    """A row of the table. measure: what it takes for a backend."""

    number: int
    name: str
    input: str
    measure: Callable[[str], list[Measured]]
    backends: tuple[str, ...] = BACKENDS


def worst(errors: Iterable[float]) -> float:
    """The largest (of one at least); infinite if one is not a number."""
    values = list(errors)
    return math.inf if any(math.isnan(v) for v in values) else float(max(values))


def difference(found, wanted) -> float:
    """The largest difference of two arrays, or of an array and a number; infinite if they differ
    in length or one holds what is not a number."""
    a, b = np.asarray(found, np.float64), np.asarray(wanted, np.float64)
    if a.ndim == b.ndim and a.shape != b.shape:
        return math.inf
    apart = np.abs(a - b)
    return worst([float(apart.max(initial=0.0))])


def broken(*arrays) -> int:
    """How many values are not finite."""
    return sum(int((~np.isfinite(array)).sum()) for array in arrays)


def broken_gradients(found) -> int:
    return broken(*(found[name] for name in PARAMETERS))
