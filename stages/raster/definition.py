"""What all backends share: constants, settings, results and the `Rasteriser` protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ResourceError
from stages.scene import Camera, Splats

ALPHA_MIN = (
    1.0 / 255.0
)  # a splat with a smaller alpha in a pixel is not drawn: 8 bits would not change
ALPHA_MAX = 0.99  # as every viewer caps it
# A pixel is finished once its transmittance is below this. Two splats at ALPHA_MAX leave 1e-4, and
# splats of alpha 1/2 leave 2^-13 or 2^-14. The limit is near none of them, so that rounding does
# not decide whether the next splat is drawn.
TRANSMITTANCE_MIN = 8.6e-5
LOG_SCALE_MAX = (
    44.0  # float32 holds the square of the scale, exp(2 x 44), but not of much larger ones
)
SCALE_MAX = math.exp(LOG_SCALE_MAX)  # also the limit of a smoothing filter's width
COLOUR_MAX = 1e20  # colours are clamped to 0..COLOUR_MAX, so that their gradients fit into float32
QUATERNION_MIN = (
    1e-20  # of the largest component; a smaller quaternion loses its rotation to rounding
)

# First column of each parameter in a row of gradients. SH coefficients follow each other, DC first,
# RGB last. A row has whole vectors of 16 columns; those after the last coefficient are zero.
MEAN, ROTATION, LOG_SCALE, OPACITY, SH, SH_REST = 0, 3, 7, 10, 11, 14
# Columns of a row of contributions of one splat to one picture. With w the splat's blend weight in
# a pixel and r = render - photograph: change of the squared error if the splat is removed; squared
# change of the picture then; sum of w; largest w; sum of w^2; sum of w r for each channel (3
# columns).
ERROR_CHANGE, PICTURE_CHANGE, WEIGHT, LARGEST_WEIGHT, SQUARED_WEIGHT, WEIGHTED_RESIDUAL = range(6)
CONTRIBUTIONS = WEIGHTED_RESIDUAL + 3


def used_columns(coefficients: int) -> int:
    """Columns in use of a gradient row for splats with so many SH coefficients a channel."""
    return SH + 3 * coefficients


def gradient_columns(coefficients: int) -> int:
    """Columns of a gradient row, in use or not: a whole number of vectors."""
    return -(-used_columns(coefficients) // 16) * 16


@dataclass(frozen=True)
class RasterSettings:
    """How to draw.

    Args:
        near: a splat is drawn if the z of its centre is larger; world units, at least 0.
        dilation_px2: added to both variances of a splat's footprint, as all viewers do; pixels^2.
        antialias: reduce the opacity by as much as the dilation enlarges the area.
        background: RGB behind everything.
        sh_degree: SH coefficients of higher degrees are ignored.

    Raises ValueError for a near plane that is negative or NaN.
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
    """A picture.

    Args:
        image: [H, W, 3] float32.
        alpha: [H, W] float32.
        depth: [H, W] float32, expected z of the splats hit, world units; 0 where alpha is 0.
        median_depth: [H, W] float32, z of the splat at which the transmittance falls below one
            half; 0 where it never does.
        culled: number of splats with values that cannot be drawn (NaN, infinite, overflowing).
            Splats out of view are not counted.
    """

    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    culled: int


class MemoryFull(ResourceError):  # noqa: N818 - names a state, as `Interrupted` does
    """A device's memory cannot hold so many splats. fits: about how many it can."""

    def __init__(self, splats: int, fits: int, room: str) -> None:
        super().__init__(
            "raster-gpu-memory",
            given=f"{splats:,} splats do not fit into the GPU's memory ({room}).",
            wanted=f"About {fits:,} would fit.",
            hint=f"Train with --max-splats {fits}, close other programs on the card, or choose "
            "--backend cpu.",
        )
        self.fits = fits


NO_SMOOTHING = np.zeros(0, np.float32)
# means, quaternions, log_scales, opacity_logits, sh, C-contiguous; and where a smoothing filter is
# used (see `raster.smoothing`), its widths [N] as a sixth.
Arrays = tuple[NDArray[np.float32], ...]


class Forward(Protocol):
    """The result of a forward pass. Its arrays are valid until the rasteriser's next pass.

    image [4 or 6, H, W] float32: RGB, alpha, and if requested expected and median depth.
    visible [V] int32: rows of the splats that touch the picture. culled: number of splats with
    values that cannot be drawn. Backends add what their backward pass needs.
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
    means2d [V, 2]: with respect to the projected mean in pixels.
    """

    rows: NDArray[np.int32]
    parameters: NDArray[np.float32]
    means2d: NDArray[np.float32]


def with_smoothing(arrays: Arrays) -> Arrays:
    """The arrays of splats and the widths of the smoothing filter, NO_SMOOTHING if not given."""
    return (*arrays, NO_SMOOTHING)[:6]


def splat_arrays(splats: Splats) -> Arrays:
    """The five parameter arrays, C-contiguous float32."""
    return tuple(np.ascontiguousarray(a, dtype=np.float32) for a in splats.arrays)


class Rasteriser(Protocol):
    """The interface of a backend. An instance must not be used by two threads at once."""

    def loaded(self, arrays: Arrays) -> Any:
        """What `forward` takes in place of `arrays` for several pictures of them: a device gets
        them once. The arrays do not change meanwhile."""

    def forward(
        self, arrays: Any, camera: Camera, settings: RasterSettings, depths: bool = False
    ) -> Any:
        """Draw. Returns this backend's own kind of `Forward`.

        Args:
            arrays: parameters of the splats, which do not change before the backward pass: `Arrays`
                or what `loaded` returned.
            camera: in the frame of the means.
            settings: how to draw.
            depths: whether to draw the depth planes.
        """

    def backward(self, forward: Any, v_image: NDArray[np.float32]) -> Backward:
        """Gradients of the visible splats from v_image [3, H, W], the gradient of the image."""

    def contributions(self, forward: Any, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """Contributions [V, CONTRIBUTIONS] of the visible splats, in the columns that the constants
        above name. residual [3, H, W]:
        render - photograph."""
