"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024): splats without detail that is finer
than the sampling of every photograph.

A splat is convolved with a Gaussian of variance 0.2 x (sampling interval)^2. The sampling interval
is the distance between two pixels at the splat, in the photograph that samples it most finely.
Scales become sqrt(s^2 + f^2), and the opacity is multiplied by the product of s / sqrt(s^2 + f^2).
From closer than any photograph was taken splats then stay soft, without needles and dust.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, Splats, logit

VARIANCE = 0.2  # in squared sampling intervals, as in the paper
RIM = 0.15  # of the picture, on each side: a splat with its mean just outside is still visible


def smoothing_widths(
    means: NDArray[np.floating], cameras: Sequence[Camera], near: float
) -> NDArray[np.float32]:
    """[N] standard deviation of each splat's filter, in the units of `means`.

    A splat that no camera sees gets the largest of all; 0 without any camera.

    Args:
        means: [N, 3].
        cameras: in the frame of `means`.
        near: near plane.
    """
    finest = np.full(len(means), np.inf)
    for camera in cameras:
        pixels, z = camera.project(means)
        size = np.array([camera.width, camera.height])
        seen = (z > near) & (np.abs(pixels - size / 2) < (0.5 + RIM) * size).all(1)
        interval = np.where(seen, z / max(camera.fx, camera.fy), np.inf)
        finest = np.minimum(finest, interval)
    known = np.isfinite(finest)
    finest[~known] = finest[known].max() if known.any() else 0.0
    return np.asarray((np.sqrt(VARIANCE) * finest).astype(np.float32))


def smoothed(splats: Splats, widths: NDArray[np.float32]) -> Splats:
    """The splats with the filter applied to their parameters, for viewers that have no filter."""
    log_scales = splats.log_scales.astype(np.float64)
    with np.errstate(divide="ignore"):
        log_widths = np.log(widths.astype(np.float64))[:, None]
    widened = 0.5 * np.logaddexp(2 * log_scales, 2 * log_widths)
    opacities = splats.opacities * np.exp((log_scales - widened).sum(1))
    smallest = np.finfo(np.float32).tiny
    return replace(
        splats,
        log_scales=widened.astype(np.float32),
        opacity_logits=logit(np.clip(opacities, smallest, 1 - 1e-7)).astype(np.float32),
    )
