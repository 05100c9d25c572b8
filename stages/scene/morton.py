"""Morton order of splats: neighbours in space are mostly neighbours in the file and in memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import Splats

BITS = 21  # three times 21 fit into 64
# shifts and masks that insert two zero bits after each of BITS bits
SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(splats: Splats) -> NDArray[np.intp]:
    """[N] rows of `splats` in Morton order of their means."""
    return morton_order_of(splats.means)


def morton_order_of(means: NDArray[np.floating]) -> NDArray[np.intp]:
    """[N] rows of means [N, 3] along a Morton curve (interleaved bits of x, y, z). Equal means keep
    their order.

    The bits are those of the coordinates' ranks, not of their values: otherwise one distant splat
    would leave all others in one cell. NaN is last on its axis.
    """
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(_ranks(means[:, axis])) << np.uint64(2 - axis)
    return np.argsort(code, kind="stable")


def _ranks(values: NDArray[np.floating]) -> NDArray[np.uint64]:
    """[N] rank of each value among the distinct values, scaled to the bits of one axis."""
    distinct, place = np.unique(values, return_inverse=True)
    last = max(1, len(distinct) - 1)
    return np.asarray(
        (place.reshape(-1).astype(np.uint64) * np.uint64((1 << BITS) - 1)) // np.uint64(last)
    )


def _spread(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits after each bit."""
    for shift, mask in SPREADS:
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    return bits
