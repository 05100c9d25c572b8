"""Two steps of a small scene, with masks, light and every kernel: what a sanitizer watches."""

from __future__ import annotations

import os

import numpy as np

from tests.device.results import asked

SPLATS, SIZE = 129, (47, 33)


def main() -> None:
    options, results = asked(__doc__)
    os.environ.setdefault("PYTORCH_NO_CUDA_MEMORY_CACHING", "1")  # so that bounds are allocations'
    from stages.raster.definition import RasterSettings, splat_arrays
    from stages.raster.gpu.rasteriser import GpuRasteriser
    from stages.train.loss import channel_means
    from stages.train.optimiser import LearningRates, new_model
    from stages.train.steps.gpu import GpuStep
    from stages.train.steps.step import StepInput
    from stages.train.views import Level
    from tests.scenes import camera, cloud

    n, size = (12, (17, 9)) if options.toy else (SPLATS, SIZE)
    arrays, view = splat_arrays(cloud(n, *size, degree=3)), camera(*size)
    settings = RasterSettings(antialias=True)
    for tile in (16,) if options.toy else (16, 8):
        rasteriser = GpuRasteriser(tile)
        forward = rasteriser.forward(arrays, view, settings, depths=True)
        rasteriser.contributions(forward, np.zeros((3, size[1], size[0]), np.float32))
        stepper = GpuStep(rasteriser)
        stepper.load(new_model(*(a.copy() for a in arrays)))
        pixels = np.random.default_rng(0).integers(0, 256, (3, size[1], size[0])).astype(np.uint8)
        level = Level(view, pixels, channel_means(pixels))
        for _ in range(2):
            stepper.step(StepInput(level, settings, LearningRates(), smooth=True))
        found = stepper.model()
        results.row(f"step with tiles of {tile}", f"finite: {np.isfinite(found.means).all()}")


if __name__ == "__main__":
    main()
