"""The image that a render is compared with, where a view is masked or its light is corrected.

- Cut-out views: the photograph over the background of the render.
- Views with an ignored region: there the target equals the render, so it has no gradient.
- Corrected light: the photograph in the median exposure and white balance. A channel that was
  overexposed has a target of at least its corrected value, and a brighter render is no error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import IGNORE, TRANSPARENT
from stages.scene.light import BRIGHT, gains_and_offsets
from stages.training.views import Level

Colour = tuple[float, float, float]


def target_of(
    level: Level, image: NDArray[np.float32], background: Colour
) -> NDArray[np.uint8] | NDArray[np.float32]:
    """[3, H, W] the target for `image` [>= 3, H, W], which was rendered over `background`: the
    photograph's bytes where nothing has to be done, else float32, mostly in 0..1."""
    if level.plain:
        return level.pixels
    pixels = level.pixels * np.float32(1 / 255)
    cut_out = level.mask if level.outside == TRANSPARENT else None
    solid = np.float32(1) if cut_out is None else cut_out * np.float32(1 / 255)
    if level.light is not None:
        gains, offsets = (row[:, None, None] for row in gains_and_offsets(level.light))
        overexposed = pixels >= BRIGHT
        pixels = (pixels - offsets * solid) / gains
        pixels = np.where(overexposed, np.maximum(pixels, image[:3]), pixels)
    if cut_out is not None:
        return pixels + (1 - solid) * np.array(background, np.float32)[:, None, None]
    return pixels if level.mask is None else np.where(level.mask > 0, pixels, image[:3])


def ignore_masked(level: Level, v_image: NDArray[np.float32]) -> None:
    """Set the gradient [3, H, W] to 0 in the view's ignored region."""
    if level.mask is not None and level.outside == IGNORE:
        v_image[:, level.mask == 0] = 0.0
