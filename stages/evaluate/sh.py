"""View-dependent colour: which SH degree a splat needs, and its colour without view dependence."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.contribution import blend_weights, colours_by_degree
from stages.raster.sh import own_coefficients
from stages.scene import Camera, Splats, dc_to_rgb, rgb_to_dc


def truncation_rms(splats: Splats) -> NDArray[np.float64]:
    """[N, L] the change of colour if the SH coefficients of degree l and above are dropped, for
    l = 1..L: root mean square over all directions, of the channel that changes most. Colours range
    from 0 to 1.

    The basis is orthonormal on the sphere, so the mean square of a sum of basis x coefficient is
    the sum of squared coefficients / 4 pi (Parseval).
    """
    squares = np.square(splats.sh.astype(np.float64)).max(axis=2)
    by_degree = [
        squares[:, d * d : (d + 1) ** 2].sum(axis=1) for d in range(1, splats.sh_degree + 1)
    ]
    if not by_degree:
        return np.zeros((len(splats), 0))
    tails = np.cumsum(np.stack(by_degree, axis=1)[:, ::-1], axis=1)[:, ::-1]
    return np.sqrt(tails / (4 * math.pi))


def sufficient_degrees(splats: Splats, threshold: float) -> NDArray[np.uint8]:
    """[N] the lowest degree to which each splat can be truncated without changing its colour by
    more than `threshold` (see `truncation_rms`); never above its own. Splats whose values are not
    finite keep their degree."""
    needed = (~(truncation_rms(splats) <= threshold)).sum(axis=1)
    return np.asarray(np.minimum(needed, splats.sh_degrees).astype(np.uint8))


def truncate_sh(splats: Splats, degrees: NDArray[np.uint8]) -> Splats:
    """Each splat's coefficients above its degree [N] set to zero; `sh` no wider than the highest
    degree needs."""
    narrow = splats.with_sh_degree(int(degrees.max(initial=0)))
    kept = own_coefficients(degrees, narrow.sh.shape[1])
    sh = np.where(kept, narrow.sh, narrow.sh.dtype.type(0))
    return replace(narrow, sh=sh, sh_degrees=np.minimum(degrees, narrow.sh_degrees))


def view_averaged_dc(
    splats: Splats, cameras: Iterable[Camera], backend: str
) -> NDArray[np.float32]:
    """[N, 3] the DC coefficients of each splat's mean colour over the cameras that see it, weighted
    by its blend weights in their pictures; its own DC where none sees it. For formats whose colours
    do not change with the view."""
    own = dc_to_rgb(splats.sh[:, 0].astype(np.float64))
    total, weights = np.zeros((len(splats), 3)), np.zeros((len(splats), 1))
    cameras = list(cameras)
    shown = blend_weights(splats, cameras, backend)
    for camera, (rows, weight) in zip(cameras, shown, strict=True):
        colours = colours_by_degree(splats.take(rows), camera.centre)[:, -1]
        total[rows] += weight[:, None] * colours
        weights[rows] += weight[:, None]
    seen = weights[:, 0] > 0
    own[seen] = total[seen] / weights[seen]
    return rgb_to_dc(own).astype(np.float32)
