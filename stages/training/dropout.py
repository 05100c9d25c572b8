"""Splats that sit a step out, so that none explains alone what its neighbours could.

What few photographs see is learnt by heart: fine splats that fit those photographs' very pixels,
and make needles and fog of every view between them. Dropout (Srivastava et al. 2014; for splats
Park et al. 2025, "DropGaussian") keeps neighbours able to stand in for each other. How much of it
is wanted goes with how little is known: a splat that n photographs see sits out (2 / n)^2 of the
steps. What many see loses nothing, and a large capture trains as if there were none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.training.density import estimated_view_counts

FEW = 2.0  # photographs: the share of steps is (FEW / n)^2
LARGEST_SHARE = 0.3  # of the steps, however few photographs see a splat
INVISIBLE = -20.0  # opacity's logit of what sits out
STRIDE = 0x9E3779B9  # from one splat's number to the next one's
FACTORS = (16, 0x85EBCA6B), (13, 0xC2B2AE35)  # (shift, factor) of the rounds of `noise`
_UINT32 = 2.0**32


@dataclass(frozen=True)
class Dropout:
    """Of one step. views: photographs in training. key: of its random numbers, 32 bits."""

    views: int
    key: int

    def resting(self, seen: NDArray[np.int32]) -> NDArray[np.bool_]:
        """[N] which splats sit out. seen [N]: see `estimated_view_counts`."""
        photographs = estimated_view_counts(seen, self.views)
        share = np.minimum(LARGEST_SHARE, np.square(FEW / np.maximum(photographs, 1.0)))
        return np.asarray(noise(len(seen), self.key) < share * _UINT32)


def noise(n: int, key: int) -> NDArray[np.uint32]:
    """[n] uniform over 32 bits: row and key through the finaliser of MurmurHash3 (Appleby, public
    domain), which any device computes alike and in any order."""
    h = np.arange(n, dtype=np.uint32) * np.uint32(STRIDE) + np.uint32(key)
    for shift, factor in FACTORS:
        h ^= h >> np.uint32(shift)
        h *= np.uint32(factor)
    return np.asarray(h ^ (h >> np.uint32(16)))
