"""What a masked photograph asks of its drawing.

Cut out: the photograph over the background that the drawing has. Ignored: where the photograph is
masked, drawing and photograph are taken to be alike, whatever is drawn there, and nothing is asked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import IGNORE, TRANSPARENT
from stages.training.views import Level

Colour = tuple[float, float, float]


def target_of(
    level: Level, image: NDArray[np.float32], background: Colour
) -> NDArray[np.uint8] | NDArray[np.float32]:
    """[3, H, W] what `image` [>= 3, H, W], drawn over `background`, is to be compared with: bytes
    as they are where nothing is masked, else float32 in 0..1."""
    if level.mask is None:
        return level.pixels
    pixels = level.pixels * np.float32(1 / 255)
    if level.outside == TRANSPARENT:
        light = (255 - level.mask) * np.float32(1 / 255)
        pixels += light * np.array(background, np.float32)[:, None, None]
        return pixels
    return np.where(level.mask > 0, pixels, image[:3])


def forget_ignored(level: Level, v_image: NDArray[np.float32]) -> None:
    """No gradient [3, H, W] where the photograph is to be ignored."""
    if level.mask is not None and level.outside == IGNORE:
        v_image[:, level.mask == 0] = 0.0
