"""What the kernels' own projection says of one splat, where no picture shows it."""

from __future__ import annotations

from stages.raster.camera_row import camera_row
from stages.raster.cpu.projection import (
    AXES,
    COMPENSATION,
)
from stages.raster.definition import splat_arrays
from tests.raster.kernel_values import footprint_values


def rotation(scene, view, settings):
    """[3, 3] camera rotation x the first splat's rotation."""
    values = footprint_values(0, camera_row(view, settings), splat_arrays(scene))
    return values[AXES : AXES + 9].reshape(3, 3)


def compensation(scene, view, settings):
    """What antialiasing multiplies the first splat's opacity by."""
    values = footprint_values(0, camera_row(view, settings), splat_arrays(scene))
    return float(values[COMPENSATION])
