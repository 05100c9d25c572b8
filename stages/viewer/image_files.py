"""Renderings as pictures: colours in 8 bits, depth in float32 or as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing

# From near to far; luminance decreases with depth.
_NEAR_TO_FAR = np.array(
    [(255, 247, 206), (255, 196, 96), (240, 112, 74), (174, 50, 110), (86, 26, 118), (12, 10, 48)]
)
_BACKGROUND = (0, 0, 0)


def eight_bits(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 of a rendering's colours; NaN becomes black."""
    found: NDArray[np.uint8] = np.rint(np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0).astype(
        np.uint8
    )
    return found


def save_picture(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write [H, W, 3] in the format that the suffix names. Raises SplatError."""
    from PIL import Image

    with replacing(path) as partial:
        Image.fromarray(pixels).save(partial)


def save_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write [H, W] as a TIFF of 32-bit floats: z in world units, 0 for the background. Raises
    SplatError."""
    from PIL import Image

    with replacing(path) as partial:
        Image.fromarray(np.ascontiguousarray(depth, np.float32)).save(partial, "TIFF")


def depth_range(depths: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    """(near, far): the 2nd and 98th percentile of all depths that are not background."""
    seen = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths])
    if not len(seen):
        return 1.0, 2.0
    near, far = np.percentile(seen, (2, 98))
    return float(near), float(max(far, near * 1.001))


def depth_colours(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """[H, W, 3] uint8: light where near, dark where far, linear in 1 / z; black background."""
    shown = np.isfinite(depth) & (depth > 0)
    inverse = 1.0 / np.where(shown, depth, far)
    share = np.clip((1 / near - inverse) / (1 / near - 1 / far), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(_NEAR_TO_FAR))
    colours = np.stack([np.interp(share, stops, column) for column in _NEAR_TO_FAR.T], axis=-1)
    return np.where(shown[..., None], np.rint(colours), _BACKGROUND).astype(np.uint8)
