"""What a photograph asks of its drawing, where it is masked or was taken in another light.

Cut out: the photograph over the background that the drawing has. Ignored: where the photograph is
masked, drawing and photograph are taken to be alike, whatever is drawn there, and nothing is asked.
Light: the photograph as the median one would show it; a value that was cut off as too bright asks
for no less than that, and is content with more.
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
    """[3, H, W] what `image` [>= 3, H, W], drawn over `background`, is to be compared with: bytes
    as they are where nothing has to be done, else float32, mostly in 0..1."""
    if level.plain:
        return level.pixels
    pixels = level.pixels * np.float32(1 / 255)
    cut_out = level.mask if level.outside == TRANSPARENT else None
    solid = np.float32(1) if cut_out is None else cut_out * np.float32(1 / 255)
    if level.light is not None:
        gains, offsets = (row[:, None, None] for row in gains_and_offsets(level.light))
        cut_off = pixels >= BRIGHT
        pixels = (pixels - offsets * solid) / gains
        pixels = np.where(cut_off, np.maximum(pixels, image[:3]), pixels)
    if cut_out is not None:
        return pixels + (1 - solid) * np.array(background, np.float32)[:, None, None]
    return pixels if level.mask is None else np.where(level.mask > 0, pixels, image[:3])


def forget_ignored(level: Level, v_image: NDArray[np.float32]) -> None:
    """No gradient [3, H, W] where the photograph is to be ignored."""
    if level.mask is not None and level.outside == IGNORE:
        v_image[:, level.mask == 0] = 0.0
