"""Recentring of positions that are too large for the precision of float32, such as survey
coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.scene.splats import Splats

# A float32 has a significand of 24 bits (IEEE 754). A scene that is farther from zero than 1000
# times its own spread has less than 14 bits left for the differences between its splats. Within
# 1000 units it does not matter: there positions are precise to 1/30,000 of a unit.
_FAR_SPREADS, _FAR_UNITS = 1000.0, 1000.0


def recentred(
    means: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """(means [N, 3] float32, origin [3]): the origin that was taken out of the means is added to
    the given one.

    Means that are far from zero for their spread are moved near zero by whole units; others are
    unchanged, and so are means that float32 holds as they are, because nothing is gained. A value
    too large for float32 becomes infinite.
    """
    with np.errstate(over="ignore"):
        plain = means.astype(np.float32)
    if np.array_equal(plain, means, equal_nan=True):
        return plain, origin.copy()
    finite = means[np.isfinite(means).all(axis=1)]
    shift = np.zeros(3)
    if len(finite):
        middle = np.median(finite, axis=0)
        spread = np.median(np.abs(finite - middle), axis=0).max()
        if np.abs(middle).max() > max(_FAR_UNITS, _FAR_SPREADS * spread):
            shift = np.rint(middle)
    with np.errstate(over="ignore"):
        return (means - shift).astype(np.float32), origin + shift


def recentred_splats(splats: Splats) -> Splats:
    """Splats that `recentred` moved: their means, now float32, origin and first camera."""
    means, origin = recentred(splats.means.astype(np.float64), splats.origin)
    camera = splats.first_camera
    if camera is not None:
        shift = np.eye(4)
        shift[:3, 3] = origin - splats.origin
        camera = camera.moved(shift)
    return replace(splats, means=means, origin=origin, first_camera=camera)
