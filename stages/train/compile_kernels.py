"""`python -m stages.train.compile_kernels cpu`: compile the kernels that a run needs.

It renders one splat and makes one training step with it, so that the kernels are compiled for the
types that training calls them with. A process that runs it in the background must wait for its end
before it renders: two processes that compile the same kernel would both write it to the cache.
"""

from __future__ import annotations

import gc
import sys

import numpy as np

from stages.base.parent import die_with_parent
from stages.raster.backends import backend_of
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings
from stages.scene import Camera
from stages.train.optimiser import LearningRates, new_model
from stages.train.steps.cpu import CpuStep
from stages.train.steps.step import StepInput
from stages.train.views import Level

_SIDE = 16  # pixels


def compile_kernels() -> None:
    """All of the CPU backend that every preset uses."""
    camera = Camera(_SIDE, _SIDE, _SIDE, _SIDE, _SIDE / 2, _SIDE / 2, np.eye(4))
    parameters = (np.zeros((1, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (4, 3)))
    model = new_model(*parameters)
    model.means[:] = 0.0, 0.0, 2.0
    model.quaternions[:, 0] = 1.0
    settings = RasterSettings(near=0.1)
    level = Level(camera, np.zeros((3, _SIDE, _SIDE), np.uint8), np.zeros(3, np.float32))
    rasteriser = CpuRasteriser()
    step = CpuStep(rasteriser)
    step.load(model)
    step.step(StepInput(level, settings, LearningRates()))
    forward = rasteriser.forward(model.arrays, camera, settings)
    rasteriser.contributions(forward, np.zeros((3, _SIDE, _SIDE), np.float32))


def main(arguments: list[str]) -> int:
    """arguments: the backend that the run will use. Returns the exit status."""
    die_with_parent()
    gc.disable()  # compilers throw little away: a fourteenth of the time
    if backend_of(arguments[0]).name == "cpu":
        compile_kernels()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
