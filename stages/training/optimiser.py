"""Adam (Kingma and Ba 2015) on the splats that a step has seen.

A splat out of view keeps its moments and its own count of steps, and its bias correction follows
that count: the first step of a splat first seen late is lr, not 3 lr.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.raster.pool import Pool
from stages.raster.simd import kernel, take_ticket

BETA1, BETA2 = 0.9, 0.999
# Gradients are those of H x W x loss (see `loss`), so this is about 1e-9 in the units of the mean
# loss: 1e-15, as often used, turns rounding noise into whole steps.
EPSILON = 1e-4
CHUNK = 512


@dataclass(frozen=True)
class LearningRates:
    """Step sizes, in the units of the parameters (means: world units)."""

    means: float
    quaternions: float = 1e-3
    log_scales: float = 5e-3
    opacity_logits: float = 5e-2
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4

    def row(self, bands: int) -> NDArray[np.float32]:
        """[11 + 3 bands] one rate for each column of the moments."""
        return np.array(
            [self.means] * 3
            + [self.quaternions] * 4
            + [self.log_scales] * 3
            + [self.opacity_logits]
            + [self.sh_dc] * 3
            + [self.sh_rest] * (3 * bands - 3),
            np.float32,
        )


@kernel
def _move(parameters, row, gradient, moment1, moment2, rates, first, count, scale1, scale2):
    """One splat's `count` values from column `first` on."""
    for k in range(count):
        column = first + k
        g = gradient[column if column < 11 else column + 2]
        m = np.float32(BETA1) * moment1[column] + np.float32(1.0 - BETA1) * g
        v = np.float32(BETA2) * moment2[column] + np.float32(1.0 - BETA2) * g * g
        moment1[column], moment2[column] = m, v
        root = math.sqrt(v * scale2) + np.float32(EPSILON)
        parameters[row, k] -= rates[column] * (m * scale1) / root


@kernel
def adam_step(
    ticket,
    chunk,
    visible,
    gradients,
    means,
    quaternions,
    log_scales,
    opacity_logits,
    sh,
    moment1,
    moment2,
    steps,
    rates,
    ndc_x,
    ndc_y,
    gradient_sum,
    gradient_count,
):
    """Move the visible splats; add up the size of their mean's gradient on the picture.

    gradients [V, 13 + 3 bands]: see CpuRasteriser.backward. rates [11 + 3 bands]. ndc_x, ndc_y:
    factors that take a gradient per pixel to the units of the densification threshold.
    sh [N, 3 bands allocated], opacity_logits [N, 1]: 2-D views of the parameters.
    """
    n = len(visible)
    bands3 = gradients.shape[1] - 13
    while True:
        start = take_ticket(ticket) * chunk
        if start >= n:
            break
        for rank in range(start, min(start + chunk, n)):
            i = visible[rank]
            g = gradients[rank]
            finite = True
            for k in range(len(g)):
                finite = finite and math.isfinite(g[k])
            if not finite:
                continue
            steps[i] += 1
            scale1 = np.float32(1.0 / (1.0 - BETA1 ** np.float64(steps[i])))
            scale2 = np.float32(1.0 / (1.0 - BETA2 ** np.float64(steps[i])))
            m1, m2 = moment1[i], moment2[i]
            _move(means, i, g, m1, m2, rates, 0, 3, scale1, scale2)
            _move(quaternions, i, g, m1, m2, rates, 3, 4, scale1, scale2)
            _move(log_scales, i, g, m1, m2, rates, 7, 3, scale1, scale2)
            _move(opacity_logits, i, g, m1, m2, rates, 10, 1, scale1, scale2)
            _move(sh, i, g, m1, m2, rates, 11, bands3, scale1, scale2)
            gradient_sum[i] += math.sqrt((g[11] * ndc_x) ** 2 + (g[12] * ndc_y) ** 2)
            gradient_count[i] += 1


@dataclass
class Model:
    """The splats in training and all that their optimisation remembers.

    Parameters as in `Splats`, float32. moment1, moment2 [N, 11 + 3 bands]: columns mean 0:3,
    quaternion 3:7, log-scales 7:10, opacity 10, SH 11:. steps [N] int32: how often each was moved.
    gradient_sum, gradient_count [N]: since the last densification.
    """

    means: NDArray[np.float32]
    quaternions: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    sh: NDArray[np.float32]
    moment1: NDArray[np.float32]
    moment2: NDArray[np.float32]
    steps: NDArray[np.int32]
    gradient_sum: NDArray[np.float32]
    gradient_count: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def arrays(self) -> tuple[NDArray[np.float32], ...]:
        """What the rasteriser takes."""
        return (self.means, self.quaternions, self.log_scales, self.opacity_logits, self.sh)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Model:
        """The rows named by an index or a mask, moments and all."""
        return Model(*(np.ascontiguousarray(array[index]) for array in vars(self).values()))

    def joined(self, other: Model) -> Model:
        """The rows of both."""
        mine, theirs = vars(self).values(), vars(other).values()
        return Model(*(np.concatenate(pair) for pair in zip(mine, theirs, strict=True)))

    def fresh(self) -> Model:
        """The same parameters with nothing remembered."""
        return new_model(*(array.copy() for array in self.arrays))

    def forget_gradients(self) -> None:
        self.gradient_sum[:] = 0.0
        self.gradient_count[:] = 0


def new_model(
    means: NDArray[np.float32],
    quaternions: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    sh: NDArray[np.float32],
) -> Model:
    """A model whose optimiser has seen nothing."""
    n, columns = len(means), 11 + 3 * sh.shape[1]
    return Model(
        means,
        quaternions,
        log_scales,
        opacity_logits,
        sh,
        np.zeros((n, columns), np.float32),
        np.zeros((n, columns), np.float32),
        np.zeros(n, np.int32),
        np.zeros(n, np.float32),
        np.zeros(n, np.int32),
    )


def apply_gradients(
    pool: Pool,
    model: Model,
    visible: NDArray[np.int32],
    gradients: NDArray[np.float32],
    rates: LearningRates,
    width: int,
    height: int,
) -> None:
    """One step of Adam on `model`, in place."""
    bands = (gradients.shape[1] - 13) // 3
    pixels = width * height
    pool.share(
        adam_step,
        CHUNK,
        visible,
        gradients,
        model.means,
        model.quaternions,
        model.log_scales,
        model.opacity_logits.reshape(-1, 1),
        model.sh.reshape(len(model), -1),
        model.moment1,
        model.moment2,
        model.steps,
        rates.row(bands),
        np.float32(0.5 * width / pixels),
        np.float32(0.5 * height / pixels),
        model.gradient_sum,
        model.gradient_count,
    )
