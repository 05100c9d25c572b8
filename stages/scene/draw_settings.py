"""How splats were fitted to their photographs, and so how they are drawn and judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera
from stages.scene.capture import TRANSPARENT, View, scene_extent
from stages.scene.quantiles import quantiles

NEAR_SHARE = 0.01  # of the cameras' extent: nearer than that no photograph is in focus
# Of the box of the middle 98 % of the splats, where no camera tells: a scene is mostly seen from
# within or just outside its box, which is then some two to three extents across.
NEAR_SHARE_OF_BOX = 0.004
_MIDDLE = (0.01, 0.99)


@dataclass(frozen=True)
class DrawSettings:
    """What decides a picture of splats besides the camera; it travels with them.

    near: a splat is drawn if the z of its centre is larger; world units. 0 where nobody knows:
        files of other programs do not tell.
    side: longer side of the photographs that the splats were fitted to and are judged on, pixels;
        0 where there were none.
    background: grey behind everything, 0 to 1: black, or white where photographs are cut out.
    light: whether photographs are brought to their median light (`scene.light`) first.
    """

    near: float = 0.0
    side: int = 0
    background: float = 0.0
    light: bool = False

    def camera(self, camera: Camera) -> Camera:
        """`camera` at the size that the splats are judged at; never enlarged."""
        return camera.fitted(self.side) if self.side else camera


def draw_settings_of(views: tuple[View, ...], side: int = 0, light: bool = False) -> DrawSettings:
    """How splats fitted to these photographs are drawn. light: as in `Look`."""
    cut_out = any(view.outside == TRANSPARENT for view in views)
    return DrawSettings(near_plane(views), side, float(cut_out), light)


def near_plane(views: tuple[View, ...]) -> float:
    """The near plane of a capture, world units; see `NEAR_SHARE`."""
    return NEAR_SHARE * scene_extent(views)


def near_plane_of(means: NDArray[np.floating]) -> float:
    """A near plane for splats [N, 3] that come without cameras, world units."""
    if not np.isfinite(means).all(axis=1).any():
        return NEAR_SHARE
    low, high = quantiles(means, _MIDDLE)
    return max(NEAR_SHARE_OF_BOX * float(np.linalg.norm(high - low)), 1e-8)
