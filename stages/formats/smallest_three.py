"""Smallest-three encoding of quaternions: the largest component follows from the unit norm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIMIT = np.sqrt(0.5)  # the second largest component of a unit quaternion is at most this


def split(quaternions: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """(index of the largest component [N], the other components [N, 3] in -LIMIT..LIMIT).

    quaternions [N, 4]: unit, with components in any order. q and -q are the same rotation; the sign
    is chosen so that the largest component is positive.
    """
    rows = np.arange(len(quaternions))
    largest = np.abs(quaternions).argmax(axis=1)
    signs = np.where(quaternions[rows, largest] < 0, -1.0, 1.0)
    others = quaternions[rows[:, None], _columns(largest)].astype(np.float64)
    return largest, np.clip(others * signs[:, None], -LIMIT, LIMIT)


def join(largest: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float32]:
    """[N, 4] unit quaternions, the inverse of `split`."""
    exact = others.astype(np.float64)
    rows = np.arange(len(exact))
    quaternions = np.empty((len(exact), 4))
    quaternions[rows[:, None], _columns(largest)] = exact
    quaternions[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(exact).sum(axis=1)))
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.asarray((quaternions / norms).astype(np.float32))


def fractions_of(others: NDArray[np.floating]) -> NDArray[np.floating]:
    """-LIMIT..LIMIT as 0..1, which most formats store in integers."""
    return np.asarray(0.5 + others / (2 * LIMIT))


def from_fractions(fractions: NDArray[np.floating]) -> NDArray[np.floating]:
    """The inverse of `fractions_of`."""
    return np.asarray((fractions - 0.5) * 2 * LIMIT)


def _columns(largest: NDArray[np.integer]) -> NDArray[np.intp]:
    """[N, 3] the indices of the other components, ascending."""
    table = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]], np.intp)
    return np.asarray(table[largest])
