"""A training step for any rasteriser: loss and optimiser in float64, written from definitions.

It is slow; the steps with kernels are tested against it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import (
    LOG_SCALE,
    MEAN,
    OPACITY,
    ROTATION,
    SH,
    Backward,
    used_columns,
)
from stages.raster.sh import own_coefficients
from stages.scene import TRANSPARENT
from stages.scene.light import BRIGHT, OFFSET, POWER
from stages.train.gauss_newton import CURVATURE_DECAY
from stages.train.loss import SSIM_WEIGHT
from stages.train.optimiser import (
    BETA1,
    BETA2,
    COLUMN_COUNTS,
    EPSILON,
    LARGEST_GRADIENT,
    LearningRates,
    Model,
    active_counts,
)
from stages.train.steps.step import HostStep, StepInput
from stages.train.views import Colour, Level

_RADIUS, _SIGMA = 5, 1.5  # of SSIM's window
_C1, _C2 = 0.01**2, 0.03**2


class ReferenceStep(HostStep):
    """See `step.TrainingStep`."""

    def step(self, given: StepInput) -> float:
        level, settings, size = given.level, given.settings, given.level.pixels.shape[:0:-1]
        forward = self.rasteriser.forward(self.arrays(given), level.camera, settings)
        image = torch.tensor(forward.image[:3], dtype=torch.float64, requires_grad=True)
        value = reference_loss(*compared(level, image, settings.background))
        torch.autograd.backward(given.weight * math.prod(size) * value)
        assert image.grad is not None
        v_image = image.grad.numpy().astype(np.float32)
        if (signs := self.sign_picture(given)) is not None:
            derivatives = self.rasteriser.backward(forward, signs)
            measure_curvature(self._model, derivatives, given.rates.extent)
        backward = self.rasteriser.backward(forward, v_image)
        if given.use_gradients is not None:
            given.use_gradients(self._model, backward)
        update(
            *(self._model, backward, (settings.sh_degree + 1) ** 2, given.rates),
            *(size[0], size[1], given.damping),
        )
        return float(value.detach())


def compared(level: Level, image: Tensor, background: Colour) -> tuple[Tensor, Tensor]:
    """(render, target) that the loss compares; see `train.views`."""
    target = torch.tensor(level.pixels, dtype=torch.float64) / 255
    drawn, inside = image.detach(), torch.ones_like(target[0])
    if level.mask is not None:
        inside = torch.tensor(level.mask, dtype=torch.float64) / 255
    solid = inside if level.outside == TRANSPARENT else torch.ones_like(inside)
    if level.light is not None:
        gain = 2 ** (torch.tensor(level.light, dtype=torch.float64)[:, None, None] / POWER)
        even = (target - OFFSET * (gain - 1) * solid) / gain
        target = torch.where(target >= BRIGHT, torch.maximum(even, drawn), even)
    if level.outside == TRANSPARENT:
        behind = torch.tensor(background, dtype=torch.float64)[:, None, None]
        return image, target + (1 - inside) * behind
    return torch.where(inside > 0, image, drawn), torch.where(inside > 0, target, drawn)


def reference_loss(image: Tensor, target: Tensor) -> Tensor:
    """0.8 L1 + 0.2 (1 - SSIM) of pictures [3, H, W]; outside the picture, both have the target's
    mean. See `loss_kernels` for the definition."""
    mean = target.mean((1, 2), keepdim=True)
    score = _ssim(image - mean, target - mean, mean)
    l1 = (image - target).abs().mean()
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - score)


def _ssim(x: Tensor, y: Tensor, mean: Tensor) -> Tensor:
    """Of pictures less the `mean` of the second."""
    taps = torch.exp(-((torch.arange(2 * _RADIUS + 1) - _RADIUS) ** 2) / (2 * _SIGMA**2)).to(x)
    window = (taps[:, None] * taps[None] / taps.sum() ** 2)[None, None]

    def blur(maps: Tensor) -> Tensor:
        return functional.conv2d(maps[:, None], window, padding=_RADIUS)[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    variances = blur(x * x) - mean_x**2 + blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    full_x, full_y = mean_x + mean, mean_y + mean
    score = (2 * full_x * full_y + _C1) * (2 * covariance + _C2)
    score = score / ((full_x**2 + full_y**2 + _C1) * (variances + _C2))
    return score.mean()


def update(
    model: Model,
    backward: Backward,
    coefficients: int,
    rates: LearningRates,
    width: int,
    height: int,
    damping: float = 0.0,
) -> None:
    """One sparse step of Adam or of `gauss_newton`, as `optimiser.apply_gradients` does it."""
    rows, g, whole = _valid(backward, rates.extent)
    columns = g.shape[1]
    model.steps[rows, : active_counts(coefficients)] += 1
    t = np.maximum(model.steps[rows], 1).astype(np.float64)[:, COLUMN_COUNTS[:columns]]
    m = BETA1 * model.moment1[rows, :columns] + (1 - BETA1) * g
    model.moment1[rows, :columns] = m
    m = m / (1 - BETA1**t)
    rate = np.broadcast_to(rates.row(coefficients), m.shape).astype(np.float64)
    rate[:, MEAN:ROTATION] *= model.distances[rows, None]
    if damping:
        h = model.moment2[rows, :columns].astype(np.float64)
        h[:, MEAN:ROTATION] /= rates.extent
        shift = rate * np.clip(m / (damping * h * rate + EPSILON), -1.0, 1.0)
        shift = np.where(h > 0, shift, 0.0)
    else:
        v = BETA2 * model.moment2[rows, :columns] + (1 - BETA2) * g * g
        model.moment2[rows, :columns] = v
        shift = rate * m / (np.sqrt(v / (1 - BETA2**t)) + EPSILON)
    model.means[rows] -= shift[:, MEAN:ROTATION]
    model.quaternions[rows] -= shift[:, ROTATION:LOG_SCALE]
    model.log_scales[rows] -= shift[:, LOG_SCALE:OPACITY]
    model.opacity_logits[rows] -= shift[:, OPACITY]
    by_coefficient = shift[:, SH : used_columns(coefficients)].reshape(len(rows), coefficients, 3)
    own = own_coefficients(model.sh_degrees[rows], coefficients)
    model.sh[rows, :coefficients] -= np.where(own, by_coefficient, 0.0)
    gradient = backward.means2d[whole].astype(np.float64) * (0.5 * width, 0.5 * height)
    model.gradient_sum[rows] += np.hypot(*gradient.T) / (width * height)
    model.gradient_count[rows] += 1


def measure_curvature(model: Model, derivatives: Backward, extent: float) -> None:
    """As `optimiser.measure_curvature` does it."""
    rows, d, _ = _valid(derivatives, extent)
    h = model.moment2[rows, : d.shape[1]].astype(np.float64)
    average = CURVATURE_DECAY * h + (1 - CURVATURE_DECAY) * d * d
    model.moment2[rows, : d.shape[1]] = np.where(h > 0, average, d * d)


def _valid(
    backward: Backward, extent: float
) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.bool_]]:
    """(rows of the splats whose gradients can be used, these gradients, by means those per extent;
    which rows of `backward` they are)."""
    parameters = backward.parameters.astype(np.float64)
    parameters[:, MEAN:ROTATION] *= extent
    whole = np.asarray((np.abs(parameters) <= LARGEST_GRADIENT).all(1))
    return backward.rows[whole], parameters[whole], whole
