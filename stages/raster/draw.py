"""Draw splats with any backend."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stages.raster.backends import AUTO, rasteriser_of
from stages.raster.definition import RasterSettings, Rendering, splat_arrays
from stages.scene import Camera, Splats
from stages.scene.draw_settings import near_plane_of


def render(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings | None = None,
    backend: str = AUTO,
    smoothing: NDArray[np.float32] | None = None,
) -> Rendering:
    """Draw `splats` as `camera` sees them.

    Args:
        splats: N splats.
        camera: in the frame of `splats.means`; `splats.local` moves other cameras there.
        settings: by default `raster_settings_of(splats)`.
        backend: see `raster.backends`. Raises ValueError for an unknown one.
        smoothing: [N] width of each splat's 3D smoothing filter, world units; None for none. See
            `raster.smoothing`.
    """
    return renderer(splats, settings, backend, smoothing)(camera)


def renderer(
    splats: Splats,
    settings: RasterSettings | None = None,
    backend: str = AUTO,
    smoothing: NDArray[np.float32] | None = None,
) -> Callable[[Camera], Rendering]:
    """A function that draws the same splats from one camera after another and keeps its buffers.
    Its results are copies. Arguments as of `render`."""
    chosen = settings or raster_settings_of(splats)
    rasteriser, arrays = rasteriser_of(backend), splat_arrays(splats)
    if smoothing is not None:
        arrays = (*arrays, np.ascontiguousarray(smoothing, np.float32))

    def draw(camera: Camera) -> Rendering:
        forward = rasteriser.forward(arrays, camera, chosen, depths=True)
        image = forward.image
        return Rendering(
            np.ascontiguousarray(image[:3].transpose(1, 2, 0)),
            image[3].copy(),
            image[4].copy(),
            image[5].copy(),
            forward.culled,
        )

    return draw


def raster_settings_of(splats: Splats) -> RasterSettings:
    """By the draw settings of `splats`; without a near plane there, by the extent of the splats."""
    drawn = splats.draw_settings
    near = drawn.near or near_plane_of(splats.means)
    return RasterSettings(near, antialias=drawn.antialias, background=(drawn.background,) * 3)
