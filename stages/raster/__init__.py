"""The rasteriser: several backends, one definition (`reference`)."""

from stages.raster.api import RasterSettings, Rendering, render, renderer

__all__ = ["RasterSettings", "Rendering", "render", "renderer"]
