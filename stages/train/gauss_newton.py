"""Steps by the diagonal of J^T J, in place of Adam's once densification has ended.

Adam divides a gradient by the root of its mean square, so a parameter moves by its learning rate
however well the photographs determine it. J, the derivatives of the picture's values by the
parameters, says how well: J^T J is the Gauss-Newton approximation of the second derivatives of half
the squared error. A backward pass of a picture of random signs gives J^T z, and the mean square of
its entries is the diagonal h (Hutchinson 1989). The step of a parameter with the learning rate r is

    r m / (damping r h + EPSILON), at most r,

where m is Adam's first moment and h an average over measurements, which takes the place of Adam's
second moment in `Model.moment2`. This is a diagonal trust region, as in Sophia (Liu et al. 2023,
2305.14342) and 3DGS2-TR (2602.00395). EPSILON, Adam's own, keeps rounding noise from moving what
hardly shows. A parameter whose h is not known yet does not move, so h is measured in every step
until each training view has been drawn once.

The damping is more than 1 because splats that overlap move together, and because the slope of an
absolute error r is that of a squared one with the curvature 1 / r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.train.random_bits import signs

# Of a run of the published length. A shorter one divides it by what multiplies its learning rates.
DAMPING = 1400.0
CURVATURE_DECAY = 0.95  # of the average, each time that a splat is measured
# x the learning rate of opacities: where one is near 0 or 1, slope and curvature both vanish, and a
# step is as large as the rate. With the whole rate, noise makes splats transparent for good.
OPACITY_RATE = 0.1
INTERVAL = 4  # steps from one measurement to the next later, which costs a backward pass


@dataclass(frozen=True)
class GaussNewton:
    """That a step moves by h.

    Args:
        damping: see the module.
        key: 32 random bits for the signs if the step measures h before it moves, else None.
    """

    damping: float
    key: int | None = None


def sign_picture(shape: tuple[int, ...], key: int, weight: float) -> NDArray[np.float32]:
    """[3, H, W] the random signs, for a loss whose gradients are multiplied by `weight`."""
    return signs(shape, key) * np.float32(weight**0.5)
