"""Compiles every variant of every kernel, side by side, and counts the processor's time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from typing import Any

import numpy as np

from tests.device.results import asked

# (SH degree that is stored, degree that is drawn, tile, whether footprints are float64)
STANDARD = ((2, 0, 16, True), (2, 1, 16, True), (2, 2, 16, True))
OTHERS = (
    *((3, active, 16, True) for active in range(4)),
    *((1, active, 16, True) for active in range(2)),
    (0, 0, 16, True),
    *((3, 3, tile, real) for tile, real in ((8, True), (8, False), (16, False))),
)
WORKERS = 12


def one(stored: int, active: int, tile: int, double: bool) -> dict[str, Any]:
    """Draw, differentiate and step once; seconds of compilation by kernel."""
    import triton
    import triton.language as tl

    from stages.raster.definition import RasterSettings, splat_arrays
    from stages.raster.gpu.rasteriser import GpuRasteriser
    from stages.train.loss import channel_means
    from stages.train.optimiser import LearningRates, new_model
    from stages.train.steps.gpu import GpuStep
    from stages.train.steps.step import StepInput
    from stages.train.views import Level
    from tests.scenes import camera, cloud

    compiled: dict[str, float] = {}

    def noted(*, src: Any, times: Any, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            spent = times.total / 1e6
            compiled[src.name] = compiled.get(src.name, 0.0) + spent

    triton.knobs.compilation.listener = noted
    arrays = splat_arrays(cloud(20, 40, 30, stored))
    rasteriser = GpuRasteriser(tile, tl.float64 if double else tl.float32)
    settings, view = RasterSettings(sh_degree=active), camera(40, 30)
    forward = rasteriser.forward(arrays, view, settings, depths=True)
    rasteriser.contributions(forward, np.zeros((3, 30, 40), np.float32))
    stepper = GpuStep(rasteriser)
    stepper.load(new_model(*(a.copy() for a in arrays)))
    pixels = np.full((3, 30, 40), 128, np.uint8)
    level = Level(view, pixels, channel_means(pixels))
    for _ in range(2):
        stepper.step(StepInput(level, settings, LearningRates()))
    stepper.model()
    return {"compiled": compiled, "cpu_s": time.process_time()}


def main() -> None:
    if len(sys.argv) > 1 and sys.argv[1] == "--one":
        print(json.dumps(one(*json.loads(sys.argv[2]))))
        return
    options, results = asked(__doc__)
    configurations = STANDARD[:1] if options.toy else (*STANDARD, *OTHERS)
    began, left = time.monotonic(), list(configurations)
    running: dict[Any, subprocess.Popen[str]] = {}
    found: dict[str, Any] = {}
    while left or running:
        while left and len(running) < min(WORKERS, os.cpu_count() or 1):
            job = left.pop(0)
            words = [sys.executable, "-m", "tests.device.warm", "--one", json.dumps(job)]
            running[job] = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        for job, process in list(running.items()):
            if process.poll() is None:
                continue
            said = process.stdout.read() if process.stdout else ""
            with results.attempt(f"compiling {job}"):
                found[str(job)] = json.loads(said.splitlines()[-1])
            results.put("variants", found)
            del running[job]
        time.sleep(0.05)
    results.row("variants compiled", f"{len(found)} in {time.monotonic() - began:.0f} s")
    spent = {k: sum(v["compiled"].values()) for k, v in found.items()}
    if spent:
        worst = max(spent, key=spent.__getitem__)
        results.row("compilation of one, most", f"{spent[worst]:.1f} CPU s: {worst}", "20")


if __name__ == "__main__":
    main()
