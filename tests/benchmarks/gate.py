"""The gate before any timing: kernels give the reference's pictures and gradients."""

from __future__ import annotations

import sys

import numpy as np

from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE


def check_kernels() -> None:
    """Exit with what differs, if anything does."""
    for n, width, height in ((0, 17, 9), (1, 1, 1), (300, 47, 33), (2000, 130, 70)):
        scene, view = cloud(n, width, height), camera(width, height)
        settings = RasterSettings(background=(0.2, 0.4, 0.1))
        pictures = [render(scene, view, settings, b).image for b in ("cpu", "reference")]
        difference = float(np.abs(pictures[0] - pictures[1]).max())
        if difference > FLOAT32_IMAGE:
            sys.exit(f"gate: picture of {n} splats at {width}x{height} is off by {difference:.2g}")
        v = np.random.default_rng(0).normal(size=(height, width, 3))
        found = gradients("cpu", scene, view, v, settings)
        wanted = exact_gradients(scene, view, v, settings)
        for name in PARAMETERS:
            off = relative(found[name], wanted[name])
            if off > FLOAT32_GRADIENT:
                sys.exit(f"gate: gradient of {name}, {n} splats: off by {off:.2g}")
    print("gate: pictures and gradients agree with the reference")
