"""Every tolerance of the rasteriser's and trainer's tests, with its reason. One place to argue."""

FLOAT32_IMAGE = 1e-5
"""Images by float32 kernels against float64: about 60 roundings of values up to 1 (2^-24 each) and
an exponential good to 2e-7."""

FLOAT32_GRADIENT = 2e-5
"""Gradients, relative to the largest of their kind: sums of up to a few thousand float32 terms."""

FLOAT32_SHIFT = 1e-6
"""The same picture by the same kernels after a change that should not matter."""

FINITE_DIFFERENCE = 1e-5
"""Autograd in float64 against central differences of step 1e-6: truncation and cancellation both
leave about 1e-9; the scenes' curvature takes the rest."""

NEEDLE_1E3 = 1e-4
"""Alpha of a needle of aspect 1e3 with sigma 1000 px: what Cauchy-Binet and Cholesky together
leave of an error of 2.4e-2."""

NEEDLE_1E4 = 1e-3
"""The same for aspect 1e4 and sigma 1e4 px, of an error of 1.0."""

ORACLE = 1e-9
"""The reference against the textbook formula in extended precision."""

WORKED = 6e-5
"""Examples worked by hand are printed to 4 or 5 digits."""

BLEED = 1e-4
"""Light that may still pass when a pixel is finished."""

MANY_LAYERS = 1e-4
"""Gradients through 4000 layers, relative: T recovered by division drifts by 1.3e-5."""

COMPENSATION = 1e-5
"""Opacity compensation of a splat far smaller than a pixel, relative."""

SCALED_QUATERNION = 1e-6
"""Relative; a quaternion's length must not matter."""

LOSS_GRADIENT = 2e-6
"""Gradient of L1 + SSIM, relative to the largest: the mean is removed before squares are taken."""
