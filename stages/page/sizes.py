"""The sizes of splats that the page's viewer draws."""

from __future__ import annotations

import math

import numpy as np

from stages.scene import Splats

# The viewer holds sizes as 16-bit floats, and this is the smallest that those hold in full.
SMALLEST = 2.0**-14  # units
_SHARP = 1e-3  # units; with a median splat as large a scene shows nothing of the rounding
_MOST_TENS = 12  # what would need more are points


def blurred(splats: Splats) -> str:
    """A warning where the page blurs the scene, with what to do; "" where it does not. The median
    of the splats' largest axes decides."""
    largest = splats.log_scales.max(axis=1, initial=-np.inf)
    median = math.exp(float(np.median(largest))) if len(largest) else SMALLEST
    if not 0 < median < SMALLEST:
        return ""
    tens = math.ceil(math.log10(_SHARP / median))
    if tens > _MOST_TENS:
        return ""
    return (
        "The page shows this scene blurred: its viewer rounds sizes too coarsely below "
        f"{SMALLEST:.2g} units, and half of the splats are smaller than {median:.2g}. "
        "`splat render` draws them right. "
        f"`splat edit --scale 1e{tens}` makes a scene that the page shows sharp."
    )
