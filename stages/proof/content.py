"""The result of independent readers, and how they build splats from the values of a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.row_slices import ROWS, row_slices
from stages.scene import Splats

# From the axes of a file to ours. Not taken from the writers: their error must not check itself.
Y_DOWN, Y_UP = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])


class NotCrossCheckedError(Exception):
    """The file uses what an independent reader does not understand; the message names it. That says
    nothing about whether the file is right."""


@dataclass(frozen=True)
class FileContent:
    """What a file holds.

    Attributes:
        splats: in the axes of the file.
        world_from_file: [4, 4] from these axes to ours (y down).
    """

    splats: Splats
    world_from_file: NDArray[np.float64]


def logits(p: NDArray[np.floating]) -> NDArray[np.float64]:
    """Logits of opacities, which are kept away from 0 and 1."""
    inside = np.clip(p, 1e-30, 1 - 1e-9, dtype=np.float64)
    return np.asarray(np.log(inside / (1 - inside)))


def says_antialiased(comments: Iterable[str]) -> bool:
    """Whether a comment of a .ply asks for opacity compensation: Brush's or Postshot's."""
    asking = (["splatrendermode:", "mip"], ["antialiased", "1"])
    return any(comment.lower().split() in asking for comment in comments)


def splats_of(**arrays: NDArray[np.floating]) -> Splats:
    """Splats of float32 arrays, named as the fields of `Splats`; the degree follows from `sh`."""
    values = {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
    n, k = values["sh"].shape[:2]
    for name, width in {"means": 3, "quaternions": 4, "log_scales": 3}.items():
        values[name] = values[name].reshape(n, width)
    return Splats(**values, sh_degrees=np.full(n, math.isqrt(k) - 1, np.uint8))  # type: ignore[arg-type]


def splats_by_rows(
    count: int, values_of: Callable[[slice], dict[str, NDArray[np.floating]]], rows: int = ROWS
) -> Splats:
    """`splats_of` the arrays that `values_of` returns for slices of so many rows."""
    return splats_of(**arrays_by_rows(count, values_of, rows))


def arrays_by_rows(
    count: int, values_of: Callable[[slice], dict[str, NDArray[np.floating]]], rows: int = ROWS
) -> dict[str, NDArray[np.floating]]:
    """float32 arrays of `count` rows, of what `values_of` returns for slices of so many rows."""
    arrays: dict[str, NDArray[np.floating]] = {}
    for part in row_slices(count, rows) if count else [slice(0, 0)]:
        for name, values in values_of(part).items():
            if name not in arrays:
                arrays[name] = scratch.empty((count, *values.shape[1:]))
            arrays[name][part] = values
    return arrays
