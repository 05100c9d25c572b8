"""What every backend agrees on: the constants, how to draw, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ALPHA_MIN = 1.0 / 255.0  # below it a splat is not drawn in a pixel: it could not change 8 bits
ALPHA_MAX = 0.99  # as every viewer caps it
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished once less light than this passes
LOG_SCALE_MAX = 44.0  # exp(2 x 44) is the last square of a scale that float32 holds
QUATERNION_MIN = 1e-20  # largest component; below it a rotation is lost to rounding


@dataclass(frozen=True)
class RasterSettings:
    """How to draw.

    near: a splat is drawn if the z of its centre is larger; world units.
    dilation_px2: added to both variances of a splat's footprint, as all viewers do; pixels^2.
    antialias: make up in opacity for what the dilation adds in area.
    background: RGB behind everything.
    sh_degree: bands above it are ignored.
    """

    near: float = 0.01
    dilation_px2: float = 0.3
    antialias: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3


@dataclass(frozen=True)
class Rendering:
    """image [H, W, 3], alpha [H, W], depth and median_depth [H, W] float32.

    depth: expected z of what was hit, world units; 0 where alpha is 0. median_depth: z of the splat
    behind which less than half of the light passes; 0 where more than half passes to the end.
    culled: splats with values that cannot be drawn (NaN, infinite, overflowing), which is not the
    same as out of view.
    """

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    culled: int
