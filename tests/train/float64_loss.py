"""The loss in float64 torch, written from its definition."""

import torch
import torch.nn.functional as functional

from stages.train.loss import SSIM_WEIGHT


def reference(image, target):
    """(loss, SSIM) in float64 torch, written from the definition."""
    mean = target.mean((1, 2), keepdim=True)
    taps = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = (taps[:, None] * taps[None] / taps.sum() ** 2)[None, None]

    def blur(x):
        return functional.conv2d(x[:, None], window, padding=5)[:, 0]

    x, y = image - mean, target - mean
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    cov = blur(x * y) - mean_x * mean_y
    full_x, full_y = mean_x + mean, mean_y + mean
    score = (2 * full_x * full_y + 1e-4) * (2 * cov + 9e-4)
    score = score / ((full_x**2 + full_y**2 + 1e-4) * (var_x + var_y + 9e-4))
    l1 = (image - target).abs().mean()
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - score.mean()), score.mean()
