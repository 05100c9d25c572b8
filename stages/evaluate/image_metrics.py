"""Image quality metrics: PSNR (dB), SSIM (Wang et al. 2004) and FLIP (Andersson et al. 2020).

Images are [H, W, 3], data range 1, sRGB values as stored. `valid` [H, W] marks the pixels that
count; None for all.
"""

from __future__ import annotations

import math
from importlib.util import find_spec

import cv2
import numpy as np
from numpy.typing import NDArray

IDENTICAL_DB = 99.0  # the PSNR of identical pictures is infinite, which JSON has no number for
Valid = NDArray[np.bool_] | None


def psnr(image: NDArray[np.floating], truth: NDArray[np.floating], valid: Valid = None) -> float:
    """Peak signal-to-noise ratio in dB over all samples, in float64; inf for equal images, NaN
    where no pixel counts."""
    difference = np.asarray(image, np.float64) - np.asarray(truth, np.float64)
    if valid is not None:
        difference = difference[valid]
    if not difference.size:
        return math.nan
    mse = float(np.mean(difference * difference))
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def capped_psnr_db(
    image: NDArray[np.floating], truth: NDArray[np.floating], valid: Valid = None
) -> float:
    """PSNR of `image`, clipped to [0, 1] as a screen does, at most `IDENTICAL_DB`; 0 if it is not a
    number."""
    found = psnr(np.clip(image, 0.0, 1.0), truth, valid)
    return 0.0 if np.isnan(found) else min(found, IDENTICAL_DB)


def psnr_text(psnr_db: float, digits: int = 2) -> str:
    """A capped PSNR for people: "34.21 dB", or "exact" for identical pictures."""
    return "exact" if psnr_db >= IDENTICAL_DB else f"{psnr_db:.{digits}f} dB"


def ssim(image: NDArray[np.floating], truth: NDArray[np.floating], valid: Valid = None) -> float:
    """Mean structural similarity (Wang et al. 2004): Gaussian window 11x11, sigma 1.5, zero
    padded, K1 = 0.01, K2 = 0.03; in float64. Pixels that do not count are taken to be equal."""
    image = _equal_outside(image, truth, valid)
    a = np.asarray(image, np.float64)
    b = np.asarray(truth, np.float64)
    weights = cv2.getGaussianKernel(11, 1.5)

    def blur(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.sepFilter2D(x, -1, weights, weights, borderType=cv2.BORDER_CONSTANT))

    mean_a, mean_b = blur(a), blur(b)
    means, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    covariance, variances = blur(a * b) - means, blur(a * a + b * b) - squares
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * means + c1) * (2 * covariance + c2) / ((squares + c1) * (variances + c2))
    return _mean(score, valid)


def has_flip() -> bool:
    """Whether the evaluator of FLIP is installed: it has no wheels for Python 3.14."""
    return find_spec("flip_evaluator") is not None


def flip(image: NDArray[np.floating], truth: NDArray[np.floating], valid: Valid = None) -> float:
    """Mean FLIP error (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating
    Images"), from 0 for equal images to 1, at 67 pixels per degree: the difference that is seen
    when the two alternate. Computed by its authors' evaluator."""
    import flip_evaluator

    image = _equal_outside(image, truth, valid)
    pair = (np.ascontiguousarray(x, np.float32) for x in (truth, image))
    errors, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean) if valid is None else _mean(np.asarray(errors)[..., 0], valid)


def _equal_outside(
    image: NDArray[np.floating], truth: NDArray[np.floating], valid: Valid
) -> NDArray[np.floating]:
    return image if valid is None else np.where(valid[..., None], image, truth)


def _mean(values: NDArray[np.floating], valid: Valid) -> float:
    return float(np.mean(values if valid is None else values[valid]))
