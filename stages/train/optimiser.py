"""Adam (Kingma and Ba 2015), sparse: it updates the splats that are visible in a step, or all. With
its first moment alone, the steps of `gauss_newton`.

A splat that is not visible keeps its moments and its own numbers of steps, and its bias correction
uses those numbers: the first step of a splat that is first visible late is lr, not 3 lr. Each group
of columns that starts by itself has a number of steps: the opacity, and each SH degree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import (
    LOG_SCALE,
    MEAN,
    OPACITY,
    ROTATION,
    SH,
    SH_REST,
    Arrays,
    Backward,
    gradient_columns,
    used_columns,
)
from stages.raster.kernels.pool import Pool
from stages.raster.kernels.simd import (
    kernel,
    splat16,
    take_ticket,
    vabs,
    vany,
    vfma,
    vge,
    vgt,
    vload,
    vmax,
    vmin,
    vnot,
    vselect,
    vsqrt,
    vstore,
)
from stages.raster.smoothing import smoothing_widths
from stages.scene import Camera
from stages.scene.morton import morton_order_of
from stages.seed.neighbours import nearest_distance
from stages.train.free_space import FreeSpace
from stages.train.gauss_newton import CURVATURE_DECAY

BETA1, BETA2 = 0.9, 0.999
# Gradients are those of H x W x loss (see `loss`), so this is about 1e-9 in the units of the mean
# loss: 1e-15, as often used, turns rounding noise into whole steps. Means count in extents of the
# scene, so that neither this nor LARGEST_GRADIENT depends on the unit of length.
EPSILON = 1e-4
# A step with a larger gradient is skipped: it is a numerical accident. Valid gradients are much
# smaller. The square of this one is far from overflow in float32. A gradient of 1e15 in the moments
# would keep the splat from moving for 70,000 steps.
LARGEST_GRADIENT = 1e12
# Columns of `Model.steps`: all parameters from the start, the opacity, SH degrees 1 to 3.
BASIC_STEPS, OPACITY_STEPS, SH_STEPS = 0, 1, 2
STEP_COUNTS = SH_STEPS + 3
CHUNK = 512
# Extents of the scene: a splat beside a camera still moves as other cameras need it.
LEAST_DISTANCE = 0.1
_F = np.float32


def _column_counts() -> NDArray[np.int64]:
    """[64] the column of `Model.steps` that each column of a gradient row uses."""
    counts = np.full(gradient_columns(16), BASIC_STEPS)
    counts[OPACITY] = OPACITY_STEPS
    for degree in (1, 2, 3):
        counts[used_columns(degree**2) :] = SH_STEPS + degree - 1
    return counts


def active_counts(coefficients: int) -> int:
    """How many columns of `Model.steps`, from the first, a step with so many SH coefficients
    advances."""
    return SH_STEPS + math.isqrt(coefficients) - 1


COLUMN_COUNTS = _column_counts()
# [STEP_COUNTS x 64] 1 where a column uses that count, else 0
_GROUPS = (np.arange(STEP_COUNTS)[:, None] == COLUMN_COUNTS).astype(np.float32).ravel()
GROUP_SIZE = len(COLUMN_COUNTS)


@dataclass(frozen=True)
class LearningRates:
    """Learning rates, in the units of the parameters (means: world units). extent: of the scene,
    world units; gradients by means are multiplied by it."""

    means: float = 0.0
    quaternions: float = 1e-3
    log_scales: float = 5e-3
    opacity_logits: float = 5e-2
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    extent: float = 1.0

    def scaled(self, means: float, factor: float, extent: float = 1.0) -> LearningRates:
        """All rates times `factor`, but that of the means, which is `means`."""
        others = {name: rate * factor for name, rate in vars(self).items()}
        return LearningRates(**others | {"means": means, "extent": extent})

    def row(self, coefficients: int) -> NDArray[np.float32]:
        """The rate of each column of a gradient row with so many SH coefficients."""
        rates = np.zeros(gradient_columns(coefficients), np.float32)
        rates[MEAN:ROTATION], rates[ROTATION:LOG_SCALE] = self.means, self.quaternions
        rates[LOG_SCALE:OPACITY], rates[OPACITY] = self.log_scales, self.opacity_logits
        rates[SH:SH_REST], rates[SH_REST : used_columns(coefficients)] = self.sh_dc, self.sh_rest
        return rates


@kernel
def _count(steps, i, counts, corrections, scales):
    """Advance the first `counts` counts of row i; write their bias corrections into `scales`."""
    last = len(corrections) - 1
    for group in range(counts):
        steps[i, group] += 1
        t = min(np.int64(steps[i, group]), last)
        scales[group, 0], scales[group, 1] = corrections[t, 0], corrections[t, 1]


@kernel
def _scales_of(scales, counts, k):
    """Bias corrections of both moments for columns k to k + 16."""
    scale1, scale2 = splat16(_F(0.0)), splat16(_F(0.0))
    for group in range(counts):
        share = vload(_GROUPS, group * GROUP_SIZE + k)
        scale1 = vfma(share, splat16(scales[group, 0]), scale1)
        scale2 = vfma(share, splat16(scales[group, 1]), scale2)
    return scale1, scale2


@kernel
def _is_invalid(gradients, at, columns):
    """Whether one of the gradients at `at` is larger than LARGEST_GRADIENT or not finite."""
    largest = splat16(_F(LARGEST_GRADIENT))
    invalid = False
    for k in range(0, columns, 16):
        invalid |= vany(vnot(vge(largest, vabs(vload(gradients, at + k)))))
    return invalid


@kernel
def _update_moments(gradients, at, columns, moment1, moment2, own, rates, scales, counts, shift):
    """Update the moments at `own` with the gradients at `at`; write the step of each parameter into
    `shift`."""
    b1, c1 = splat16(_F(BETA1)), splat16(_F(1.0 - BETA1))
    b2, c2 = splat16(_F(BETA2)), splat16(_F(1.0 - BETA2))
    epsilon = splat16(_F(EPSILON))
    for k in range(0, columns, 16):
        g = vload(gradients, at + k)
        m = vfma(b1, vload(moment1, own + k), c1 * g)
        v = vfma(b2, vload(moment2, own + k), c2 * g * g)
        vstore(moment1, own + k, m)
        vstore(moment2, own + k, v)
        scale1, scale2 = _scales_of(scales, counts, k)
        step = vload(rates, k) * m * scale1 / (vsqrt(v * scale2) + epsilon)
        vstore(shift, k, step)


@kernel
def _damped_steps(
    gradients, at, columns, moment1, curvature, own, rates, units, scales, counts, shift, damping
):
    """As `_update_moments`, by the curvature, which does not change: see `gauss_newton`. units:
    factors from rates to the units of what derivatives are by."""
    b1, c1 = splat16(_F(BETA1)), splat16(_F(1.0 - BETA1))
    epsilon, zero = splat16(_F(EPSILON)), splat16(_F(0.0))
    for k in range(0, columns, 16):
        m = vfma(b1, vload(moment1, own + k), c1 * vload(gradients, at + k))
        vstore(moment1, own + k, m)
        scale1, _ = _scales_of(scales, counts, k)
        h, rate = vload(curvature, own + k), vload(rates, k)
        step = rate * m * scale1 / vfma(splat16(damping) * h, rate * vload(units, k), epsilon)
        step = vmax(vmin(step, rate), zero - rate)
        vstore(shift, k, vselect(vgt(h, zero), step, zero))


@kernel
def average_squares(ticket, chunk, visible, derivatives, curvature):
    """Add the squares of derivatives [M, columns] to the averages of the visible splats in
    `curvature` [N, columns]; 0 there means that none is known. A splat with a derivative larger
    than LARGEST_GRADIENT, or not finite, does not change."""
    columns, row_width = derivatives.shape[1], curvature.shape[1]
    decay, rest = splat16(_F(CURVATURE_DECAY)), splat16(_F(1.0 - CURVATURE_DECAY))
    zero = splat16(_F(0.0))
    while True:
        start = take_ticket(ticket) * chunk
        if start >= len(visible):
            break
        for rank in range(start, min(start + chunk, len(visible))):
            at, own = rank * columns, np.int64(visible[rank]) * row_width
            if _is_invalid(derivatives, at, columns):
                continue
            for k in range(0, columns, 16):
                d, h = vload(derivatives, at + k), vload(curvature, own + k)
                known = vfma(decay, h, rest * d * d)
                vstore(curvature, own + k, vselect(vgt(h, zero), known, d * d))


@kernel
def _move(i, shift, means, quaternions, log_scales, opacity_logits, sh, n_sh):
    """Subtract `shift` from the parameters of splat i, and from its first `n_sh` of `sh`."""
    for k in range(3):
        means[i, k] -= shift[MEAN + k]
        log_scales[i, k] -= shift[LOG_SCALE + k]
    for k in range(4):
        quaternions[i, k] -= shift[ROTATION + k]
    opacity_logits[i] -= shift[OPACITY]
    for k in range(n_sh):
        sh[i, k] -= shift[SH + k]


@kernel
def move_splats(
    ticket,
    chunk,
    visible,
    gradients,
    means2d,
    model,
    counts,
    corrections,
    rates,
    ndc_x,
    ndc_y,
    extent,
    damping,
):
    """Update the visible splats; accumulate the norm of the gradient by their 2D positions.

    A splat with a gradient larger than LARGEST_GRADIENT, or not finite, does not change.

    Args:
        visible, gradients, means2d: see `raster.definition.Backward`.
        model: the arrays of `Model`; sh is [N, 3 coefficients], 2-D. Coefficients above a splat's
            degree do not change.
        counts: how many columns of steps are advanced, from the first.
        corrections: [T, 2] 1 / (1 - beta^t) of both betas.
        rates: [columns of gradients] learning rates; that of a mean is multiplied by its splat's
            `Model.distances`.
        ndc_x, ndc_y: factors from a gradient per pixel to the units of the densification threshold.
        extent: of the scene, which gradients by means are multiplied by.
        damping: see `gauss_newton`; 0 to move as Adam.
    """
    means, quaternions, log_scales, opacity_logits, sh, sh_degrees = model[:6]
    moment1, moment2, steps, gradient_sum, gradient_count = model[6:11]
    distances = model[12]
    n = len(visible)
    columns = gradients.shape[1]
    row_width, n_sh = moment1.shape[1], min(columns - SH, sh.shape[1])
    shift, units = np.zeros(columns, np.float32), np.ones(columns, np.float32)
    scales = np.empty((STEP_COUNTS, 2), np.float32)
    while True:
        start = take_ticket(ticket) * chunk
        if start >= n:
            break
        for rank in range(start, min(start + chunk, n)):
            i = visible[rank]
            if _is_invalid(gradients, rank * columns, columns):
                continue
            _count(steps, i, counts, corrections, scales)
            at, own = rank * columns, np.int64(i) * row_width
            if damping > 0.0:
                units[MEAN:ROTATION] = distances[i] / extent
                _damped_steps(
                    gradients,
                    *(at, columns, moment1, moment2, own, rates, units, scales, counts, shift),
                    damping,
                )
            else:
                _update_moments(
                    gradients, at, columns, moment1, moment2, own, rates, scales, counts, shift
                )
            for k in range(MEAN, ROTATION):
                shift[k] *= distances[i]
            used = 3 * (np.int64(sh_degrees[i]) + 1) ** 2
            _move(i, shift, means, quaternions, log_scales, opacity_logits, sh, min(n_sh, used))
            gx, gy = means2d[rank, 0] * ndc_x, means2d[rank, 1] * ndc_y
            gradient_sum[i] += math.sqrt(gx * gx + gy * gy)
            gradient_count[i] += 1


def bias_corrections() -> NDArray[np.float32]:
    """[T, 2] 1 / (1 - beta^t) for both betas, until it is 1 in float32; row 0 is never used."""
    t = np.maximum(np.arange(20_000), 1)[:, None].astype(np.float64)
    return (1.0 / (1.0 - np.array([BETA1, BETA2]) ** t)).astype(np.float32)


@dataclass
class Model:
    """The splats in training and the state of their optimiser.

    Parameters as in `Splats`, float32; sh_degrees too: coefficients above a splat's degree are not
    trained. moment1, moment2: columns as the gradient's, for all coefficients; steps by
    `gauss_newton` have the curvature in moment2.
    steps [N, STEP_COUNTS] int32: numbers of steps, by groups of columns. gradient_sum,
    gradient_count [N]: since the last densification. smoothing [N]: widths of the 3D smoothing
    filter, 0 for none. distances [N]: to the nearest camera, in extents of the scene; they
    scale the steps of means, so that these are alike in a picture; see `camera_distances`.
    """

    means: NDArray[np.float32]
    quaternions: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    sh: NDArray[np.float32]
    sh_degrees: NDArray[np.uint8]
    moment1: NDArray[np.float32]
    moment2: NDArray[np.float32]
    steps: NDArray[np.int32]
    gradient_sum: NDArray[np.float32]
    gradient_count: NDArray[np.int32]
    smoothing: NDArray[np.float32]
    distances: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def arrays(self) -> Arrays:
        """What the rasteriser takes."""
        return (self.means, self.quaternions, self.log_scales, self.opacity_logits, self.sh)

    def drawn(self, smooth: bool) -> Arrays:
        """As `arrays`; with the widths of the smoothing filter if `smooth`."""
        return (*self.arrays, self.smoothing) if smooth else self.arrays

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Model:
        """The rows of an index or a mask, with their moments."""
        return Model(*(np.ascontiguousarray(array[index]) for array in vars(self).values()))

    def joined(self, other: Model) -> Model:
        """The rows of both."""
        mine, theirs = vars(self).values(), vars(other).values()
        return Model(*(np.concatenate(pair) for pair in zip(mine, theirs, strict=True)))

    def fresh(self) -> Model:
        """A copy of the parameters with a new optimiser state."""
        found = new_model(*(array.copy() for array in self.arrays))
        found.sh_degrees[:] = self.sh_degrees
        return found

    def reset_gradients(self) -> None:
        self.gradient_sum[:] = 0.0
        self.gradient_count[:] = 0

    def reset_moment2(self) -> None:
        self.moment2[:] = 0.0

    # A model on a device computes what follows there (`steps.device_model`).

    def on_host(self) -> Model:
        """The model in arrays of its own on the host; the model itself if it is there."""
        return self

    def finite(self) -> NDArray[np.bool_]:
        """[N] splats whose parameters all are finite."""
        good = np.ones(len(self), bool)
        for array in self.arrays:
            good &= np.isfinite(array).all(tuple(range(1, array.ndim)))
        return good

    def in_morton_order(self) -> Model:
        """The model with its rows in Morton order."""
        return self.take(morton_order_of(self.means))

    def camera_distances(self, cameras: Sequence[Camera], extent: float) -> NDArray[np.float32]:
        """See `camera_distances`; an array or a tensor, as `distances` takes it."""
        return camera_distances(self.means, cameras, extent)

    def smoothing_widths(self, cameras: Sequence[Camera], near: float) -> NDArray[np.float32]:
        """See `raster.smoothing`; an array or a tensor, as `smoothing` takes it."""
        return smoothing_widths(self.means, cameras, near)

    def in_free_space(self, space: FreeSpace) -> NDArray[np.bool_]:
        """[N] splats in free space."""
        return space.contains(self.means)


def new_model(
    means: NDArray[np.float32],
    quaternions: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    sh: NDArray[np.float32],
) -> Model:
    """A model with a new optimiser state; each splat has all coefficients of `sh`."""
    n, columns = len(means), gradient_columns(sh.shape[1])
    return Model(
        means,
        quaternions,
        log_scales,
        opacity_logits,
        sh,
        np.full(n, math.isqrt(sh.shape[1]) - 1, np.uint8),
        np.zeros((n, columns), np.float32),
        np.zeros((n, columns), np.float32),
        np.zeros((n, STEP_COUNTS), np.int32),
        np.zeros(n, np.float32),
        np.zeros(n, np.int32),
        np.zeros(n, np.float32),
        np.ones(n, np.float32),
    )


def empty_model() -> Model:
    """No splats at all."""
    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))
    return new_model(*(np.zeros(shape, np.float32) for shape in shapes))


def camera_distances(
    means: NDArray[np.float32], cameras: Sequence[Camera], extent: float
) -> NDArray[np.float32]:
    """[N] distance of each of the means [N, 3] to the nearest camera, in extents of the scene, at
    least LEAST_DISTANCE; 1 for means that are not finite, and without cameras."""
    found = np.ones(len(means))
    finite = np.isfinite(means).all(1)
    if cameras and finite.any():
        centres = np.array([camera.centre for camera in cameras])
        found[finite] = nearest_distance(means[finite].astype(np.float64), centres) / extent
    return np.maximum(found, LEAST_DISTANCE).astype(np.float32)


_CORRECTIONS = bias_corrections()


def apply_gradients(
    pool: Pool,
    model: Model,
    backward: Backward,
    coefficients: int,
    rates: LearningRates,
    width: int,
    height: int,
    damping: float = 0.0,
) -> None:
    """One step on `model`, in place; gradients by means become those per extent.

    Args:
        coefficients: number of SH coefficients that the gradients hold.
        rates: learning rates.
        width, height: of the picture.
        damping: to move by the curvature in `model.moment2`, see `gauss_newton`; 0 to move as Adam.
    """
    pixels = width * height
    _in_extents(backward, rates.extent)
    flat = replace(model, sh=model.sh.reshape(len(model), 3 * model.sh.shape[1]))
    pool.share(
        *(move_splats, CHUNK, backward.rows, backward.parameters, backward.means2d),
        *(tuple(vars(flat).values()), active_counts(coefficients), _CORRECTIONS),
        rates.row(coefficients),
        *(np.float32(0.5 * width / pixels), np.float32(0.5 * height / pixels)),
        *(np.float32(rates.extent), np.float32(damping)),
    )


def measure_curvature(pool: Pool, model: Model, backward: Backward, extent: float) -> None:
    """Add the squares of the derivatives of a picture of signs to `model.moment2`, in place; those
    by means become those per extent."""
    _in_extents(backward, extent)
    pool.share(average_squares, CHUNK, backward.rows, backward.parameters, model.moment2)


def _in_extents(backward: Backward, extent: float) -> None:
    with np.errstate(over="ignore", invalid="ignore"):  # then the splat does not change
        backward.parameters[:, MEAN:ROTATION] *= np.float32(extent)
