"""Row 25: SSIM where single precision fails."""

from __future__ import annotations

import numpy as np
import torch

from stages.raster.kernels.pool import Pool
from stages.train.loss import image_loss
from tests.extremes.measured import Measured, difference, worst
from tests.scenes import relative
from tests.tolerances import SSIM
from tests.train.float64_loss import reference


def ssim(backend):
    found, scores = [], []
    for what, (image, target) in _pictures().items():
        v_image = np.full_like(target, np.nan)
        score = image_loss(Pool(1), image, target, v_image).ssim
        wanted_score, wanted = _float64(image, target)
        scores.append(score)
        found.append(Measured(25, f"SSIM, {what}", abs(score - wanted_score), SSIM))
        error = _gradient_error(v_image, wanted)
        found.append(Measured(25, f"gradient, {what}, relative", error, SSIM))
    beyond = worst(max(abs(score) - 1, 0.0) for score in scores)
    return [*found, Measured(25, "SSIM outside [-1, 1] by", beyond, SSIM)]


def _pictures():
    """{what: (image, target)}. The mean of a picture that is half light and half dark is far from
    either half: removing it removes little."""
    r = np.random.default_rng(0)
    flat, white = (np.full((3, 40, 40), level, np.float32) for level in (0.6, 1.0))
    bright = (100 * r.uniform(0, 1, (3, 33, 47))).astype(np.float32)
    noisy = (bright + r.normal(0, 10, bright.shape)).astype(np.float32)
    halves = (
        np.repeat(np.array([0.95, 0.05], np.float32), 32)[None, None].repeat(3, 0).repeat(40, 1)
    )
    dimmer, closer = (
        (halves + r.normal(0, noise, halves.shape)).astype(np.float32) for noise in (0.01, 0.001)
    )
    return {
        "0.6 against 0.6 + 1e-7": (flat + np.float32(1e-7), flat),
        "flat white": (white, white),
        "white against white - 1e-7": (white - np.float32(1e-7), white),
        "exposure x 100": (noisy, bright),
        "half 0.95, half 0.05": (dimmer, halves),
        "the same, nearly alike": (closer, halves),
    }


def _gradient_error(found, wanted):
    """Relative to the largest; where all should be 0, to what L1 alone would give."""
    return relative(found, wanted) if np.abs(wanted).max() > 1e-3 else difference(found, wanted)


def _float64(image, target):
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    value, score = reference(x, torch.tensor(target, dtype=torch.float64))
    value.backward()
    assert x.grad is not None
    pixels = target.shape[1] * target.shape[2]
    return float(score.detach()), x.grad.numpy() * pixels
