"""Drawing, the backward pass and whole steps of scenes like trained ones: times by the device's
clock, by kernel, memory. With --sweep: by tile, precision and warps. With --once: one step, for a
program that reads hardware counters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import triton.language as tl

from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.gpu import blend, gradients, project
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.scene import Camera, Splats
from stages.train.gauss_newton import GaussNewton
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, new_model
from stages.train.steps import gpu_kernels
from stages.train.steps.gpu import GpuStep
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.benchmarks.gpu import median_ms
from tests.benchmarks.scenes import view
from tests.device.made import trained_like
from tests.device.results import Results, asked

COUNTS = (1_000_000, 300_000, 100_000, 3_000_000)
PICTURES = ((1280, 800), (800, 600), (1920, 1080))  # 1, 0.5 and 2 Mpixel
PROFILED = ((100_000, (800, 600)), (1_000_000, (1280, 800)), (3_000_000, (1920, 1080)))
TARGETS = {(1_000_000, 1280): "6 ms", (300_000, 1280): "3 ms"}
SWEPT = ((20_000, (480, 358)), (100_000, (800, 600)), (1_000_000, (1280, 800)))
SETTINGS = RasterSettings(near=1e-3)
CUDA = torch.cuda.is_available()


def level_of(camera: Camera) -> Level:
    r = np.random.default_rng(1)
    pixels = r.integers(0, 256, (3, camera.height, camera.width)).astype(np.uint8)
    return Level(camera, pixels, channel_means(pixels))


class Measured:
    """One scene on the device, seen at several sizes."""

    def __init__(self, splats: Splats, rasteriser: GpuRasteriser) -> None:
        self.splats, self.rasteriser = splats, rasteriser
        self.scene = rasteriser.scene(splat_arrays(splats))
        self.stepper = GpuStep(rasteriser)
        self.stepper.load(new_model(*splat_arrays(splats)))

    def figures(self, where: Camera, rounds: int) -> dict[str, float]:
        """Milliseconds, entries, memory."""
        seen = self.rasteriser.view(where, SETTINGS)
        drawn = self.rasteriser.draw(self.scene, seen)
        lengths = drawn.lists.starts.diff()
        room = int(1.5 * len(drawn.lists.members)) + 1
        found = {
            "entries": float(len(drawn.lists.members)),
            "visible": float((drawn.status == 1).sum()),
            "longest": float(lengths.max()),
            "mean": float(lengths.double().mean()),
        }
        v = torch.randn(3, where.height, where.width, device=self.rasteriser.device)
        draw = lambda: self.rasteriser.draw(self.scene, seen, capacity=room)  # noqa: E731
        found["draw_ms"] = median_ms(draw, rounds)
        drawn = draw()
        back = lambda: self.rasteriser.gradients(self.scene, seen, drawn, v)  # noqa: E731
        found["back_ms"] = median_ms(back, rounds)
        step = self.step(where)
        step()
        if CUDA:
            torch.cuda.reset_peak_memory_stats()
        found["step_ms"] = median_ms(step, rounds)
        found["host_ms"] = host_ms(step, rounds)
        found["measured_ms"] = median_ms(self.step(where, GaussNewton(300.0, 1)), rounds)
        if CUDA:
            found["bytes_a_splat"] = torch.cuda.max_memory_allocated() / len(self.splats)
        return found

    def step(self, where: Camera, moves: GaussNewton | None = None) -> Callable[[], float]:
        """A step that leaves the scene as it is, of Adam or as `moves` says."""
        rates = LearningRates().scaled(0.0, 0.0)
        given = StepInput(level_of(where), SETTINGS, rates, gauss_newton=moves)
        return lambda: self.stepper.step(given)


def host_ms(step: Callable[[], Any], rounds: int) -> float:
    """Milliseconds of a step in a row of many, which the host may delay."""
    import time

    if not CUDA:
        return 0.0
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(2 * rounds):
        step()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - began) / (2 * rounds)


def by_kernel(step: Callable[[], Any], rounds: int) -> dict[str, float]:
    """Milliseconds of a step by kernel, the longest first; launches under "launches"."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
        for _ in range(rounds):
            step()
        if CUDA:
            torch.cuda.synchronize()
    spent: dict[str, float] = {}
    launches = 0
    for event in found.key_averages():
        taken = getattr(event, "self_device_time_total", 0.0) / 1e3 / rounds
        if taken > 0.0 and str(event.device_type).endswith("CUDA"):
            spent[event.key] = spent.get(event.key, 0.0) + taken
            launches += event.count
    return {**dict(sorted(spent.items(), key=lambda item: -item[1])), "launches": launches / rounds}


def measure(results: Results, toy: bool) -> None:
    counts, pictures = ((12,), ((32, 24),)) if toy else (COUNTS, PICTURES)
    rounds = 2 if toy else 20
    lines: list[dict[str, Any]] = []
    for n in counts:
        with results.attempt(f"{n:,} splats"):
            widest = view(*pictures[0])
            one = Measured(trained_like(n, widest), GpuRasteriser())
            for size in pictures:
                found = one.figures(view(*size), rounds)
                lines.append({"splats": n, "size": size, **found})
                results.put("steps", lines)
                name = f"{n:,} at {size[0]}x{size[1]}: draw, back, step, in a row, measuring"
                keys = ("draw_ms", "back_ms", "step_ms", "host_ms", "measured_ms")
                times = (found[k] for k in keys)
                value = ", ".join(f"{x:.2f}" for x in times) + " ms"
                results.row(name, value, TARGETS.get((n, size[0]), ""))
                if toy or (n, size) in PROFILED:
                    with results.attempt("profile"):
                        profiled = by_kernel(one.step(view(*size)), rounds)
                        results.put(f"profile of {n} at {size}", profiled)
                        for kernel, ms in list(profiled.items())[:14]:
                            results.row(f"    {kernel[:40]}", f"{ms:.3f} ms")
            del one
        if CUDA:
            torch.cuda.empty_cache()


class Relaunched:
    """A kernel whose launches have other options."""

    def __init__(self, kernel: Any, **options: Any) -> None:
        self.kernel, self.options = kernel, options

    def __getitem__(self, grid: Any) -> Callable[..., Any]:
        return lambda *given, **named: self.kernel[grid](*given, **{**named, **self.options})


@contextmanager
def relaunched(module: Any, name: str, **options: Any) -> Iterator[None]:
    kept = getattr(module, name)
    setattr(module, name, Relaunched(kept, **options))
    try:
        yield
    finally:
        setattr(module, name, kept)


def sweep(results: Results, toy: bool) -> None:
    """Tiles and precision of the whole step, warps of single kernels."""
    lines: list[dict[str, Any]] = []
    for n, size in ((12, (32, 24)),) if toy else SWEPT:
        splats, where = trained_like(n, view(*size)), view(*size)
        for tile in (8, 16):
            for real in (tl.float64, tl.float32):
                with results.attempt(f"{n} splats, tile {tile}, {real}"):
                    one = Measured(splats, GpuRasteriser(tile, real))
                    found = one.figures(where, 2 if toy else 15)
                    lines.append({"splats": n, "size": size, "tile": tile, "real": str(real)})
                    lines[-1] |= found
                    results.put("sweep", lines)
                    times = (found[k] for k in ("draw_ms", "back_ms", "step_ms"))
                    value = ", ".join(f"{x:.2f}" for x in times) + " ms"
                    results.row(f"{n:,} at {size[0]}x{size[1]}, tile {tile}, {real}", value)
                    del one
        for module, name, choices in (
            (project, "project_kernel", (2, 8)),
            (gradients, "splat_gradient_kernel", (2, 8)),
            (gpu_kernels, "move_kernel", (2, 8)),
            (blend, "blend_kernel", (2, 4)),
            (blend, "blend_gradient_kernel", (2, 4)),
        ):
            for warps in () if toy and module is not blend else choices[: 1 if toy else 2]:
                with (
                    results.attempt(f"{name} with {warps} warps"),
                    relaunched(module, name, num_warps=warps),
                ):
                    found = Measured(splats, GpuRasteriser()).figures(where, 2 if toy else 15)
                    results.put(f"{n} {name} {warps} warps", found)
                    value = f"{found['draw_ms']:.2f}, {found['back_ms']:.2f} ms"
                    results.row(f"{n:,}, {name}, {warps} warps: step {found['step_ms']:.2f}", value)


def main() -> None:
    options, results = asked(__doc__, "--sweep", "--once")
    if options.sweep:
        sweep(results, options.toy)
    elif options.once:
        n, size = (12, (32, 24)) if options.toy else (300_000, (1280, 800))
        one = Measured(trained_like(n, view(*size)), GpuRasteriser())
        for _ in range(3):
            one.step(view(*size))()
    else:
        measure(results, options.toy)


if __name__ == "__main__":
    main()
