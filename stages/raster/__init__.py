"""The rasteriser: several backends, one definition (`reference`)."""

from stages.raster.definition import RasterSettings, Rendering
from stages.raster.draw import render, renderer

__all__ = ["RasterSettings", "Rendering", "render", "renderer"]
