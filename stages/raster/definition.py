"""What every backend agrees on: the constants, how to draw, and what comes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.scene import Camera, Splats

ALPHA_MIN = 1.0 / 255.0  # below it a splat is not drawn in a pixel: it could not change 8 bits
ALPHA_MAX = 0.99  # as every viewer caps it
# A pixel is finished once less light than this passes: the most that can leak. Two splats at the
# cap leave 1e-4, halves 2^-13 or 2^-14; this is near none of them, so that rounding does not decide
# whether the next splat is drawn.
TRANSMITTANCE_MIN = 8.6e-5
LOG_SCALE_MAX = 44.0  # exp(2 x 44) is the last square of a scale that float32 holds
SCALE_MAX = math.exp(LOG_SCALE_MAX)  # also of a smoothing filter's width
COLOUR_MAX = 1e20  # a colour is clamped there, as at 0: its gradients then fit into float32
QUATERNION_MIN = 1e-20  # largest component; below it a rotation is lost to rounding

# A row of gradients: where each parameter's begin. SH come basis function by basis function, RGB
# last, DC first; whole vectors of 16 columns, zero beyond the last band.
MEAN, ROTATION, LOG_SCALE, OPACITY, SH, SH_REST = 0, 3, 7, 10, 11, 14
# A row of contributions, of one splat to one picture w its weights, r render less photograph, sums
# over pixels: change of the squared error without the splat, of w, the largest w, of w^2, and of
# w r by channel (PULL to PULL + 2).
ERROR_CHANGE, WEIGHT, LARGEST_WEIGHT, SQUARED_WEIGHT, WEIGHTED_RESIDUAL = range(5)
CONTRIBUTIONS = WEIGHTED_RESIDUAL + 3


def used_columns(coefficients: int) -> int:
    """Columns of a gradient row that hold something, with `bands` (basis functions) of SH."""
    return SH + 3 * coefficients


def gradient_columns(coefficients: int) -> int:
    """Columns of a gradient row with room for `bands` of SH: whole vectors."""
    return -(-used_columns(coefficients) // 16) * 16


@dataclass(frozen=True)
class RasterSettings:
    """How to draw.

    near: a splat is drawn if the z of its centre is larger; world units, at least 0.
    dilation_px2: added to both variances of a splat's footprint, as all viewers do; pixels^2.
    antialias: make up in opacity for what the dilation adds in area.
    background: RGB behind everything.
    sh_degree: bands above it are ignored.

    Raises ValueError for a near plane behind the camera or none at all.
    """

    near: float = 0.01
    dilation_px2: float = 0.3
    antialias: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3

    def __post_init__(self) -> None:
        if not self.near >= 0:
            raise ValueError(f"near {self.near}, wanted 0 or more")


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


class MemoryFull(SplatError):  # noqa: N818 - what is full, as `Interrupted` says
    """A device's memory does not hold so many splats. fits: how many it would, about."""

    def __init__(self, splats: int, fits: int, room: str) -> None:
        super().__init__(
            "raster-gpu-memory",
            given=f"{splats:,} splats do not fit into the GPU's memory ({room}).",
            wanted=f"About {fits:,} would fit.",
            hint=f"Train with --max-splats {fits}, close what else uses the card, or choose "
            "--backend cpu.",
            family=Family.RESOURCES,
        )
        self.fits = fits


NO_SMOOTHING = np.zeros(0, np.float32)
Arrays = tuple[NDArray[np.float32], ...]  # means, quaternions, log_scales, opacity_logits, sh


class Forward(Protocol):
    """What a forward pass leaves. Its arrays are valid until the rasteriser's next pass.

    image [4 or 6, H, W] float32: RGB, alpha, and if asked for expected and median depth.
    visible [V] int32: rows of the splats that touch the picture. culled: how many splats hold
    values that cannot be drawn. What else the way back needs is the backend's own.
    """

    @property
    def image(self) -> NDArray[np.float32]: ...
    @property
    def visible(self) -> NDArray[np.int32]: ...
    @property
    def culled(self) -> int: ...


@dataclass(frozen=True)
class Backward:
    """Gradients of the visible splats, in the order of their rows.

    rows [V] int32. parameters [V, gradient_columns]: layout above.
    means2d [V, 2]: of the mean on the picture, per pixel.
    """

    rows: NDArray[np.int32]
    parameters: NDArray[np.float32]
    means2d: NDArray[np.float32]


def splat_arrays(splats: Splats) -> Arrays:
    """The five parameter arrays, C-contiguous float32."""
    return tuple(np.ascontiguousarray(a, dtype=np.float32) for a in splats.arrays)


class Rasteriser(Protocol):
    """What drawing, judging and training ask of a backend. One instance a thread of control."""

    def forward(
        self,
        arrays: Arrays,
        camera: Camera,
        settings: RasterSettings,
        smoothing: NDArray[np.float32] = NO_SMOOTHING,
        depths: bool = False,
    ) -> Any:
        """Draw; a `Forward` of this backend's own. arrays: C-contiguous float32. smoothing [N]:
        see `raster.smoothing`. depths: whether to draw the depth planes."""

    def backward(
        self,
        arrays: Arrays,
        forward: Any,
        v_image: NDArray[np.float32],
        smoothing: NDArray[np.float32] = NO_SMOOTHING,
    ) -> Backward:
        """Gradients of the visible splats, from v_image [3, H, W]."""

    def contributions(self, forward: Any, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """[V, CONTRIBUTIONS] for the visible splats, columns as above: what each alone does for
        the picture. residual [3, H, W]: render less photograph.
        """
