"""How much of a splat's colour depends on where it is seen from."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.scene import Splats


def tail_rms(splats: Splats) -> NDArray[np.float64]:
    """[N, L] the colour that a splat loses with degree l and all above, for l = 1..L: root mean
    square over all directions, of the channel that loses most; 1 is the range of a colour.

    The basis is orthonormal on the sphere, so the mean square of a sum of basis x coefficient is
    the sum of squared coefficients / 4 pi (Parseval).
    """
    squares = np.square(splats.sh.astype(np.float64)).max(axis=2)
    bands = [squares[:, d * d : (d + 1) ** 2].sum(axis=1) for d in range(1, splats.sh_degree + 1)]
    if not bands:
        return np.zeros((len(splats), 0))
    tails = np.cumsum(np.stack(bands, axis=1)[:, ::-1], axis=1)[:, ::-1]
    return np.sqrt(tails / (4 * math.pi))


def degrees_at(splats: Splats, threshold: float) -> NDArray[np.uint8]:
    """[N] the lowest degree at which each splat loses no more than `threshold` (see `tail_rms`);
    never above its own. Values that are not finite keep their degree."""
    needed = (~(tail_rms(splats) <= threshold)).sum(axis=1)
    found: NDArray[np.uint8] = np.minimum(needed, splats.sh_degrees).astype(np.uint8)
    return found


def cut(splats: Splats, degrees: NDArray[np.uint8]) -> Splats:
    """Each splat's coefficients above its degree set to zero; `sh` no wider than the highest."""
    narrow = splats.with_sh_degree(int(degrees.max(initial=0)))
    band = np.floor(np.sqrt(np.arange(narrow.sh.shape[1])))
    sh = np.where((band <= degrees[:, None])[:, :, None], narrow.sh, narrow.sh.dtype.type(0))
    return replace(narrow, sh=sh, sh_degrees=np.minimum(degrees, narrow.sh_degrees))
