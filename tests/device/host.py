"""What the host costs between steps, at a million splats: the model down and up, densification,
removals, a checkpoint, a picture of arrays. Seconds of the processor, and on the clock."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.train.optimiser import LearningRates, new_model
from stages.train.steps.gpu import GpuStep
from stages.train.steps.step import StepInput
from tests.benchmarks.scenes import view
from tests.device.made import trained_like
from tests.device.results import Results, asked
from tests.device.steps import level_of

SETTINGS = RasterSettings(near=1e-3)


def timed(results: Results, name: str, work: Callable[[], Any]) -> None:
    with results.attempt(name):
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        began, cpu = time.perf_counter(), time.process_time()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        taken, spent = time.perf_counter() - began, time.process_time() - cpu
        results.put(name, {"seconds": taken, "cpu_s": spent})
        results.row(name, f"{1e3 * taken:.1f} ms, {1e3 * spent:.1f} CPU ms")


def main() -> None:
    options, results = asked(__doc__)
    n, size = (12, (24, 16)) if options.toy else (1_000_000, (1280, 800))
    where = view(*size)
    arrays = splat_arrays(trained_like(n, where))
    rasteriser = GpuRasteriser()
    stepper = GpuStep(rasteriser)
    model = new_model(*arrays)
    timed(results, "load", lambda: stepper.load(model))
    level = level_of(where)
    given = StepInput(level, SETTINGS, LearningRates())

    def steps(count: int) -> None:
        for _ in range(count):
            stepper.step(given)

    timed(results, "first step", lambda: steps(1))
    timed(results, "10 steps", lambda: steps(10))
    timed(results, "model", stepper.model)
    with results.attempt("between steps"):
        between_steps(results, stepper, lambda: steps(1))
    timed(results, "forward of arrays, first", lambda: rasteriser.forward(arrays, where, SETTINGS))
    timed(results, "forward of arrays, again", lambda: rasteriser.forward(arrays, where, SETTINGS))
    timed(results, "draw", lambda: stepper.draw(where, SETTINGS, False))


def between_steps(results: Results, stepper: GpuStep, step: Callable[[], None]) -> None:
    """The events of a run, each after a step, as hooks make them."""
    from stages.scene import morton
    from stages.train.checkpoint import TrainingState, save_checkpoint
    from stages.train.density import GRADIENT_THRESHOLD, AdaptiveDensity, cull

    def densify() -> None:
        model = AdaptiveDensity(24).grow(
            cull(stepper.model()), int(1.05 * len(stepper)), GRADIENT_THRESHOLD
        )
        stepper.load(model.take(morton.morton_order_of(model.means)))

    def checkpoint() -> None:
        with tempfile.TemporaryDirectory() as folder:
            state = TrainingState(1, (1, 0, 0.0), [], [], [])
            save_checkpoint(Path(folder), stepper.model(), state)

    for name, work in (("densification", densify), ("checkpoint", checkpoint)):
        step()
        timed(results, name, work)


if __name__ == "__main__":
    main()
