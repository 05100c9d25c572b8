"""Exposure, white balance and vignetting of a photograph, as affine maps of its sRGB values.

Above the linear segment near black, light = ((value + 0.055) / 1.055)^2.4 (IEC 61966-2-1). So
multiplying the light by a factor is the same affine map for all values.

Vignetting is by how many EV a picture is darker at a distance r from its principal point, in half
diagonals of the picture: k1 r^2 + k2 r^4 + k3 r^6, with k1, k2, k3 >= 0.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera

OFFSET, POWER = 0.055, 2.4  # of sRGB: light is ((value + OFFSET) / (1 + OFFSET)) ** POWER
BRIGHT = 253 / 255  # from here on a value may be clipped
NOISE_EV = 0.05  # variation of one camera with fixed settings
Light = tuple[float, float, float]  # EV above the median photograph: red, green, blue
Vignetting = tuple[float, float, float]  # EV: k1, k2, k3


def gains_and_offsets(light: Light) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """([3] a, [3] b): a photograph has the value a x + b where the median photograph has x."""
    gains = 2.0 ** (np.array(light) / POWER)
    return gains.astype(np.float32), (OFFSET * (gains - 1.0)).astype(np.float32)


def linear_light(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear light in 0..1 of sRGB values in 0..1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + OFFSET) / 1.055) ** POWER)


def powers_of_radius(square: NDArray[np.floating]) -> NDArray[np.floating]:
    """[..., 3] the powers r^2, r^4 and r^6 of distances whose squares are given."""
    return np.stack([square, square**2, square**3], axis=-1)


def vignetting_gains(vignetting: Vignetting, camera: Camera) -> NDArray[np.float32]:
    """[H, W] factors g: without vignetting x, a value is g (x + OFFSET) - OFFSET."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) ** 2
    y = (np.arange(camera.height) + 0.5 - camera.cy) ** 2
    square = (x + y[:, None]) / ((camera.width**2 + camera.height**2) / 4)
    darker = (powers_of_radius(square) * vignetting).sum(axis=-1)
    return np.asarray(np.exp2(darker / -POWER), np.float32)


def spread_ev(lights: Iterable[Light | None]) -> float:
    """Root mean square over photographs and channels, EV; 0 if none is known."""
    known = np.array([light for light in lights if light is not None])
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0
