"""How far two images are apart. Definitions: data range 1, sRGB values as stored."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Kept = NDArray[np.bool_] | None  # [H, W]: the pixels that count; None for all


def psnr(image: NDArray[np.floating], truth: NDArray[np.floating], kept: Kept = None) -> float:
    """Peak signal to noise ratio in dB over all samples, in float64; inf for equal images."""
    difference = np.asarray(image, np.float64) - np.asarray(truth, np.float64)
    if kept is not None:
        difference = difference[kept]
    mse = float(np.mean(difference * difference))
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def ssim(image: NDArray[np.floating], truth: NDArray[np.floating], kept: Kept = None) -> float:
    """Mean structural similarity (Wang et al. 2004): Gaussian window 11x11, sigma 1.5, zero
    padded, K1 = 0.01, K2 = 0.03; computed in float64. What does not count is taken to be alike."""
    import cv2

    image = _alike_outside(image, truth, kept)
    a = np.asarray(image, np.float64)
    b = np.asarray(truth, np.float64)
    weights = cv2.getGaussianKernel(11, 1.5)

    def blur(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.sepFilter2D(x, -1, weights, weights, borderType=cv2.BORDER_CONSTANT))

    mean_a, mean_b = blur(a), blur(b)
    var_a = blur(a * a) - mean_a * mean_a
    var_b = blur(b * b) - mean_b * mean_b
    cov = blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    score /= (mean_a * mean_a + mean_b * mean_b + c1) * (var_a + var_b + c2)
    return _mean(score, kept)


def flip(image: NDArray[np.floating], truth: NDArray[np.floating], kept: Kept = None) -> float:
    """Mean FLIP error (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating
    Images"), 0 for equal images to 1: what an eye sees that changes between the two at 67 pixels a
    degree, as its authors' own evaluator computes it."""
    import flip_evaluator

    image = _alike_outside(image, truth, kept)
    pair = (np.ascontiguousarray(x, np.float32) for x in (truth, image))
    errors, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean) if kept is None else _mean(np.asarray(errors)[..., 0], kept)


def _alike_outside(
    image: NDArray[np.floating], truth: NDArray[np.floating], kept: Kept
) -> NDArray[np.floating]:
    return image if kept is None else np.where(kept[..., None], image, truth)


def _mean(values: NDArray[np.floating], kept: Kept) -> float:
    return float(np.mean(values if kept is None else values[kept]))
