"""Draw splats with any backend."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.raster.backends import AUTO, rasteriser_of
from stages.raster.definition import Forward, RasterSettings, Rendering, splat_arrays
from stages.scene import Camera, Splats
from stages.scene.draw_settings import near_plane_of


def render(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings | None = None,
    backend: str = AUTO,
) -> Rendering:
    """Draw `splats` as `camera` sees them.

    Args:
        splats: N splats.
        camera: in the frame of `splats.means`; `splats.local` moves other cameras there.
        settings: by default `raster_settings_of(splats)`.
        backend: see `raster.backends`. Raises ValueError for an unknown one.
    """
    return renderer(splats, settings, backend)(camera)


def renderer(
    splats: Splats, settings: RasterSettings | None = None, backend: str = AUTO
) -> Callable[[Camera], Rendering]:
    """A function that draws the same splats from one camera after another and keeps its buffers.
    Its results are copies. Arguments as of `render`."""
    chosen = settings or raster_settings_of(splats)
    rasteriser = rasteriser_of(backend)
    arrays = rasteriser.loaded(splat_arrays(splats))
    return lambda camera: rendering_of(rasteriser.forward(arrays, camera, chosen, depths=True))


def rendering_of(forward: Forward) -> Rendering:
    """A copy of the result of a forward pass with depths."""
    image = forward.image
    return Rendering(
        image[:3].transpose(1, 2, 0).copy(),
        image[3].copy(),
        image[4].copy(),
        image[5].copy(),
        forward.culled,
    )


def supersampled(draw: Callable[[Camera], Rendering], side: int) -> Callable[[Camera], Rendering]:
    """A function that draws as `draw` does, with smooth small pictures.

    A picture is drawn larger by the whole number of times that brings its longer side nearest to
    `side`, and its colour and alpha are averaged over the area of each pixel.

    A splat of a fraction of a pixel is too faint and too wide in a direct drawing: the low-pass
    filter widens it, and compensation treats it alone, not with the neighbours that fill the pixel.
    Drawn larger than in training it is too narrow, and shows gaps (docs/experiments/drawing.md).
    Depths are those of one sample in each pixel, because a mean over an edge is on no surface.

    Args:
        draw: draws one camera's picture.
        side: longer side of the pictures that the splats were trained at; 0 for unknown.
    """

    def draw_larger(camera: Camera) -> Rendering:
        factor = int(side / max(camera.width, camera.height) + 0.5)
        if factor <= 1:
            return draw(camera)
        height, width = camera.height, camera.width
        drawn = draw(camera.resized(width * factor, height * factor))
        blocks = height, factor, width, factor
        middle = slice(factor // 2, None, factor)
        return Rendering(
            drawn.image.reshape(*blocks, 3).mean((1, 3)),
            drawn.alpha.reshape(blocks).mean((1, 3)),
            np.ascontiguousarray(drawn.depth[middle, middle]),
            np.ascontiguousarray(drawn.median_depth[middle, middle]),
            drawn.culled,
        )

    return draw_larger


def raster_settings_of(splats: Splats) -> RasterSettings:
    """The rasteriser's settings by the draw settings of `splats`. If these have no near plane, it
    comes from the extent of the splats."""
    drawn = splats.draw_settings
    near = drawn.near or near_plane_of(splats.means)
    return RasterSettings(near, antialias=drawn.antialias, background=(drawn.background,) * 3)
