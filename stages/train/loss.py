"""The training loss 0.8 L1 + 0.2 (1 - SSIM) of two pictures [3, H, W] in 0..1 and its gradient by
the first (Kerbl et al. 2023, equation 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.raster.kernels.pool import Pool
from stages.train.steps.loss_kernels import loss_strips, strip_count

SSIM_WEIGHT = 0.2  # Kerbl et al. 2023


@dataclass(frozen=True)
class Loss:
    """value = 0.8 l1 + 0.2 (1 - ssim)."""

    value: float
    l1: float
    ssim: float


def channel_means(target: NDArray[np.float32] | NDArray[np.uint8]) -> NDArray[np.float32]:
    """[3] mean of each channel of a picture [3, H, W], in 0..1."""
    means = target.reshape(3, -1).mean(1, dtype=np.float64)
    found: NDArray[np.float32] = (means * _scale(target)).astype(np.float32)
    return found


def _scale(target: NDArray[np.float32] | NDArray[np.uint8]) -> np.float32:
    return np.float32(1 / 255) if target.dtype == np.uint8 else np.float32(1)


def image_loss(
    pool: Pool,
    image: NDArray[np.float32],
    target: NDArray[np.float32] | NDArray[np.uint8],
    v_image: NDArray[np.float32],
    ssim_weight: float = SSIM_WEIGHT,
    means: NDArray[np.float32] | None = None,
) -> Loss:
    """Compare image [>= 3, H, W] with target [3, H, W].

    v_image [3, H, W]: receives the gradient of H x W x value, so that its entries do not depend on
    the size of the picture. target: float32 in 0..1, or bytes. means: its `channel_means`, if
    known.
    """
    _, height, width = target.shape
    means = channel_means(target) if means is None else means
    sums = np.zeros((3 * strip_count(height), 2))
    pool.share(loss_strips, image, target, _scale(target), means, ssim_weight, v_image, sums)
    l1, ssim = (float(s) for s in sums.sum(0) / (3 * height * width))
    return Loss((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), l1, ssim)
