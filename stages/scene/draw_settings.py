"""How splats were trained, and so how they are drawn and evaluated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera
from stages.scene.capture import (
    TRANSPARENT,
    Reconstruction,
    depths_seen,
    scene_extent,
    split_held_out,
)

NEAR_SHARE = 0.01  # of the cameras' extent: photographs are not in focus nearer than that
# Of the least depth that a photograph shows. What lies nearer to a camera is no part of the scene,
# or a surface behind another photographer, a little out of place.
NEAR_SHARE_OF_DEPTH = 0.2
MISPLACED_PERCENT = 1.0  # of the points that a photograph shows
# Of the diagonal of `_densest_half`, if there are no cameras. With this share, runs on six captures
# get 0.4 to 2.8 times the near plane of their cameras.
NEAR_SHARE_OF_HALF = 0.008


@dataclass(frozen=True)
class DrawSettings:
    """How a picture of splats is drawn, apart from the camera. It is stored with the splats.

    Args:
        near: a splat is drawn if the z of its centre is larger; world units. 0 if unknown, as in
            files of other programs.
        side: longer side of the largest picture in training and evaluation, pixels; 0 if there
            were none.
        background: grey level behind everything, 0 to 1: black, or white for cut-out photographs.
        light: whether photographs are corrected to their median light (`scene.light`) first.
        antialias: whether opacities are reduced by as much as the rasteriser's dilation enlarges
            the area of a splat: the 2D Mip filter of Mip-Splatting (Yu et al. 2024, section 4.2).
            Splats are trained for one of the two and look wrong when they are drawn as the other.
    """

    near: float = 0.0
    side: int = 0
    background: float = 0.0
    light: bool = False
    antialias: bool = False

    def camera(self, camera: Camera) -> Camera:
        """`camera` at the size of training and evaluation; never enlarged."""
        return camera.fitted(self.side) if self.side else camera


def draw_settings_of(
    reconstruction: Reconstruction,
    side: int = 0,
    light: bool = False,
    antialias: bool = False,
) -> DrawSettings:
    """How splats of this reconstruction are drawn, by its training views.

    Args:
        side: that photographs are made smaller to, pixels; 0 for none.
        light, antialias: as in `DrawSettings`.
    """
    views = reconstruction.views
    if side:
        side = min(side, max((max(v.camera.width, v.camera.height) for v in views), default=side))
    cut_out = any(view.outside == TRANSPARENT for view in views)
    return DrawSettings(near_plane(reconstruction), side, float(cut_out), light, antialias)


def near_plane(reconstruction: Reconstruction) -> float:
    """The near plane of splats of this reconstruction, world units: in front of all that its
    training views show. Where one of them shows something very near, it is no nearer than a share
    of the cameras' extent; of a long row of cameras that would lie behind what most of them show.
    """
    least = [float(np.percentile(z, MISPLACED_PERCENT)) for z in depths_seen(reconstruction)]
    extent = scene_extent(split_held_out(reconstruction.views)[0])
    if not least:
        return NEAR_SHARE * extent
    usual = NEAR_SHARE_OF_DEPTH * float(np.median(least))
    return max(min(NEAR_SHARE * extent, usual), NEAR_SHARE_OF_DEPTH * min(least))


def near_plane_of(means: NDArray[np.floating]) -> float:
    """A near plane for splats with means [N, 3] and no cameras, world units. It depends on the
    densest half of the splats alone, so that neither outliers nor a sky dome move it."""
    whole = means[np.isfinite(means).all(axis=1)]
    if not len(whole):
        return NEAR_SHARE
    return max(NEAR_SHARE_OF_HALF * float(np.linalg.norm(_densest_half(whole))), 1e-8)


def _densest_half(means: NDArray[np.floating]) -> NDArray[np.float64]:
    """[3] on each axis the length of the shortest interval that holds half of the means [N, 3]."""
    further = (len(means) - 1) // 2
    lengths = np.empty(3)
    for axis in range(3):  # one at a time saves memory
        ordered = np.sort(means[:, axis].astype(np.float64))
        lengths[axis] = (ordered[further:] - ordered[: len(ordered) - further]).min()
    return lengths
