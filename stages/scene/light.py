"""Exposure and white balance of a photograph, as affine maps of its sRGB values.

Above the linear segment near black, light = ((value + 0.055) / 1.055)^2.4 (IEC 61966-2-1). So
multiplying the light by a factor is the same affine map for all values.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

OFFSET, POWER = 0.055, 2.4  # of sRGB: light is ((value + OFFSET) / (1 + OFFSET)) ** POWER
BRIGHT = 253 / 255  # from here on a value may be clipped
NOISE_EV = 0.05  # variation of one camera with fixed settings
Light = tuple[float, float, float]  # EV above the median photograph: red, green, blue


def gains_and_offsets(light: Light) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """([3] a, [3] b): a photograph has the value a x + b where the median photograph has x."""
    gains = 2.0 ** (np.array(light) / POWER)
    return gains.astype(np.float32), (OFFSET * (gains - 1.0)).astype(np.float32)


def linear_light(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear light in 0..1 of sRGB values in 0..1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + OFFSET) / 1.055) ** POWER)


def spread_ev(lights: Iterable[Light | None]) -> float:
    """Root mean square over photographs and channels, EV; 0 if none is known."""
    known = np.array([light for light in lights if light is not None])
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0
