"""The loss of a picture on a WebGPU device, and the photographs that it is compared with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster.webgpu.device import Buffers, Device, Kernel
from stages.scene import IGNORE, TRANSPARENT
from stages.scene.light import BRIGHT, gains_and_offsets
from stages.train.loss import SSIM_WEIGHT
from stages.train.steps.loss_kernels import C1, C2, RADIUS, WINDOW
from stages.train.views import Colour, Level

FILE = Path(__file__).parent / "wgsl" / "loss.wgsl"
_CONSTANTS: tuple[tuple[str, float], ...] = (
    *(("RADIUS", RADIUS), ("C1", float(C1)), ("C2", float(C2)), ("SSIM_WEIGHT", SSIM_WEIGHT)),
    *((f"TAP_{k}", float(WINDOW[k])) for k in range(RADIUS + 1)),
)
_TARGET, _SUM, _SIMILARITY, _GRADIENT = (
    Kernel(FILE, entry, _CONSTANTS)
    for entry in ("target_of", "sum_rows", "similarity", "loss_gradient")
)
_NEVER = 2.0  # no value is as bright


def photograph_of(level: Level, device: Device) -> Any:
    """The view's pixels and mask, in a buffer: four bytes a pixel."""
    opaque = np.full(level.pixels.shape[1:], 255, np.uint8)
    mask = opaque if level.mask is None else level.mask
    return device.sent(np.stack([*level.pixels, mask], 2))


class Loss:
    """The loss against a view and its gradient. sums: a buffer of three means of the target's
    channels, that of SSIM, that of |difference|, and a number for whoever reads it."""

    def __init__(self, buffers: Buffers) -> None:
        self.buffers, self.device = buffers, buffers.device
        self.sums = self.device.empty(6)

    def gradient(
        self, image: Any, photograph: Any, level: Level, background: Colour, weight: float = 1.0
    ) -> Any:
        """Record the loss of `image` [>= 3, H, W]. Returns v_image [3, H, W]: weight x the gradient
        of H x W x loss; until the next one."""
        _, height, width = level.pixels.shape
        pixels, across, down = width * height, -(-width // 16), -(-height // 16)
        squares = 3 * across * down
        target, slopes, v_image, parts = (
            self.buffers.get(name, words)
            for name, words in (
                *(("target", 3 * pixels), ("slopes", 9 * pixels), ("v_image", 3 * pixels)),
                ("parts", squares),
            )
        )
        gains, offsets = gains_and_offsets(level.light or (0.0, 0.0, 0.0))
        rule = int(level.outside == TRANSPARENT), int(level.outside == IGNORE)
        bright = _NEVER if level.light is None else BRIGHT
        colours = map(float, (*background, 0, *gains, 0, *offsets, 0))
        given = (width, height, across, down, *rule, bright, weight, *colours)
        run, rest = self.device.run, (image, target, self.sums)
        groups = -(-pixels // 256)
        run(_TARGET, groups, (photograph, image, None, None, None, target, parts), given)
        run(_SUM, 3, (parts, self.sums), (groups, 1.0 / pixels, 0))
        run(_SIMILARITY, squares, (None, *rest, None, slopes, parts), given)
        run(_SUM, 1, (parts, self.sums), (squares, 1.0 / (3 * pixels), 3))
        run(_GRADIENT, squares, (photograph, *rest, slopes, v_image, parts), given)
        run(_SUM, 1, (parts, self.sums), (squares, 1.0 / (3 * pixels), 4))
        return v_image


def loss_of(sums: NDArray[np.float32]) -> float:
    """The loss from `Loss.sums`."""
    return float((1 - SSIM_WEIGHT) * sums[4] + SSIM_WEIGHT * (1 - sums[3]))
