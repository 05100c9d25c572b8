"""One call draws splats; which kernels do it is a setting."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import RasterSettings, Rendering
from stages.scene import Camera, Splats


def render(
    splats: Splats,
    camera: Camera,
    settings: RasterSettings | None = None,
    backend: str = "auto",
    smoothing: NDArray[np.float32] | None = None,
) -> Rendering:
    """Draw `splats` as `camera` sees them.

    The camera is given in the frame of `splats.means`; `splats.local` moves one that is not.

    smoothing [N]: width of the 3D smoothing filter of each splat, world units; None for none. See
    `raster.smoothing`.

    backend: "auto" (the fastest that is present), "cpu" (Numba) or "reference" (torch).
    Raises ValueError for another name.
    """
    return renderer(splats, settings, backend, smoothing)(camera)


def renderer(
    splats: Splats,
    settings: RasterSettings | None = None,
    backend: str = "auto",
    smoothing: NDArray[np.float32] | None = None,
) -> Callable[[Camera], Rendering]:
    """What draws the same splats from one camera after another, and keeps its buffers between
    them. What it hands out is the caller's own. As `render` for the rest."""
    settings = settings or RasterSettings()
    if backend in ("auto", "cpu"):
        from stages.raster.cpu.rasteriser import renderer_cpu

        return renderer_cpu(splats, settings, smoothing)
    if backend == "reference":
        from stages.raster.reference import render_reference

        return lambda camera: render_reference(splats, camera, settings, smoothing)
    raise ValueError(f"backend {backend!r}, wanted auto, cpu or reference")
