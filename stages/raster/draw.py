"""One call draws splats; which backend does it is a setting."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stages.raster.backends import AUTO, rasteriser_of
from stages.raster.definition import NO_SMOOTHING, RasterSettings, Rendering, splat_arrays
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

    The camera is given in the frame of `splats.means`; `splats.local` moves one that is not.

    settings: `settings_of(splats)` unless told otherwise. smoothing [N]: width of the 3D smoothing
    filter of each splat, world units; None for none. See `raster.smoothing`.

    backend: see `raster.backends`. Raises ValueError for an unknown one.
    """
    return renderer(splats, settings, backend, smoothing)(camera)


def renderer(
    splats: Splats,
    settings: RasterSettings | None = None,
    backend: str = AUTO,
    smoothing: NDArray[np.float32] | None = None,
) -> Callable[[Camera], Rendering]:
    """What draws the same splats from one camera after another, and keeps its buffers between
    them. What it hands out is the caller's own. As `render` for the rest."""
    chosen = settings or raster_settings_of(splats)
    widths = NO_SMOOTHING if smoothing is None else np.ascontiguousarray(smoothing, np.float32)
    rasteriser, arrays = rasteriser_of(backend), splat_arrays(splats)

    def draw(camera: Camera) -> Rendering:
        forward = rasteriser.forward(arrays, camera, chosen, widths, depths=True)
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
    """How these splats are drawn: by their own look, or by their size where they have none."""
    near = splats.draw_settings.near or near_plane_of(splats.means)
    return RasterSettings(near=near, background=(splats.draw_settings.background,) * 3)
