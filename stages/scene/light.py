"""Exposure and white balance of a photograph, as an affine map of its sRGB values.

Above its straight toe, an sRGB value and 0.055 are a power of the light: twice the light is the
same affine map of all of them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

OFFSET, POWER = 0.055, 2.4  # of sRGB: light is ((value + OFFSET) / (1 + OFFSET)) ** POWER
BRIGHT = 253 / 255  # from here on a value may have been cut off: the light was at least that
NOISE_EV = 0.05  # of one camera that nobody touches
Light = tuple[float, float, float]  # EV above the median photograph: red, green, blue


def gains_and_offsets(light: Light) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """([3], [3]) a and b: a photograph has a x + b where the median one has x."""
    gains = 2.0 ** (np.array(light) / POWER)
    return gains.astype(np.float32), (OFFSET * (gains - 1.0)).astype(np.float32)


def spread_ev(lights: Iterable[Light | None]) -> float:
    """Root mean square over photographs and channels; 0 where nothing is known."""
    known = np.array([light for light in lights if light is not None])
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0
