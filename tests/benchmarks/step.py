"""How long a training step takes, and where: `python -m tests.benchmarks.step`.

The step is the trainer's own: photograph to float, drawing, L1 + SSIM, backward pass, Adam and the
statistics for densification. Nothing is timed before kernels and reference agree, on a step too.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stages.base.stage import Report
from stages.raster.definition import gradient_columns
from stages.raster.kernels.pool import Pool
from stages.scene import Camera, DrawSettings, Splats
from stages.train.loss import channel_means
from stages.train.optimiser import Model, new_model
from stages.train.schedule import SCALES, Schedule
from stages.train.views import Level, TrainingView
from tests.benchmarks.gate import check_kernels
from tests.benchmarks.scenes import PICTURES, random_scene, trained_scene, view
from tests.benchmarks.timing import (
    TimedPool,
    busy_core,
    growth,
    interleaved,
    kernel_seconds,
    machine,
    peak_bytes,
    rounds_for,
)
from tests.train.pictures import trainer_of

BLENDING = ("blend_tiles", "blend_gradient_tiles")
LATE = 9_000  # a step with all of the picture and all degrees; steps are small by then
console = Console(width=150)


class Stepper:
    """A trainer with one photograph and a model, stepped again and again."""

    def __init__(self, splats: Splats, camera: Camera, pool: Pool, backend: str = "cpu") -> None:
        r = np.random.default_rng(1)
        photograph = r.integers(0, 256, (3, camera.height, camera.width)).astype(np.uint8)
        photograph[:] = photograph.mean(2, keepdims=True)  # stripes: something to fit, not noise
        level = Level(camera, photograph, channel_means(photograph))
        photo = TrainingView("stripes", (level,) * len(SCALES))
        schedule = Schedule(10_000, 1e-3, splats.sh_degree, len(splats), 0)
        folder = Path(tempfile.gettempdir())
        self.trainer = trainer_of(
            schedule,
            [photo],
            [],
            DrawSettings(1e-5),
            len(splats),
            folder,
            Report(),
            backend=backend,
        )
        step: Any = self.trainer.stepper
        self.rasteriser = step.rasteriser
        self.rasteriser.pool = pool
        self.model: Model = new_model(
            *(
                np.array(a, np.float32, order="C")
                for a in (
                    splats.means,
                    splats.quaternions,
                    splats.log_scales,
                    splats.opacity_logits,
                    splats.sh,
                )
            )
        )
        self.trainer.stepper.load(self.model)
        self.camera = camera

    def __call__(self) -> None:
        self.trainer.step(LATE)

    def size(self) -> tuple[int, int]:
        """(visible splats, intersections)."""
        settings = self.trainer.raster_settings(3)
        forward = self.rasteriser.forward(self.model.arrays, self.camera, settings)
        return len(forward.visible), forward.n_intersections


def check_step() -> None:
    """Exit unless a step of the kernels moves all parameters as a step of the reference does."""
    camera = view(131, 75)
    scene = random_scene(800, camera, degree=2)
    ours, wanted = (Stepper(scene, camera, Pool(2), name) for name in ("cpu", "reference"))
    ours()
    wanted()
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        before = getattr(scene, name)
        moved = [getattr(s.model, name) - before for s in (ours, wanted)]
        # Adam's first step is the sign of the gradient: where that is rounding noise it is free
        agree = np.isclose(moved[0], moved[1], rtol=1e-2, atol=1e-3 * np.abs(moved[1]).max())
        if agree.mean() < 0.995:
            sys.exit(f"gate: {name} moves differently in {1 - agree.mean():.2%} of its values")
    print("gate: a step moves the splats as the reference's step does")


def stages_of(seconds: dict[str, float]) -> tuple[float, float]:
    """(blending, everything else) in seconds."""
    blending = sum(seconds[name] for name in BLENDING)
    return blending, seconds["total"] - blending


def one_row(name: str, splats: Splats, camera: Camera) -> tuple[list[str], dict[str, float]]:
    pool = TimedPool()
    stepper = Stepper(splats, camera, pool)
    seconds = kernel_seconds(pool, stepper, rounds_for(stepper))
    blending, rest = stages_of(seconds)
    visible, intersections = stepper.size()
    fresh = Stepper(splats, camera, pool)
    first = peak_bytes(fresh)
    again = peak_bytes(fresh)
    coefficients = stepper.model.sh.shape[1]
    first -= 4 * gradient_columns(coefficients) * visible  # the gradients themselves
    allowed = 150 * visible + 24 * intersections + 60 * camera.width * camera.height
    row = [
        name,
        f"{visible:,}",
        f"{intersections:,}",
        f"{1e3 * seconds['total']:.1f}",
        f"{1e3 * blending:.1f}",
        f"{rest / blending:.2f}",
        f"{1e9 * seconds['total'] / max(visible, 1):.0f}",
        f"{first / 2**20:.0f}",
        f"{first / allowed:.2f}",
        f"{again / 2**20:.1f}",
    ]
    return row, seconds


def table_of_sizes(largest: int, runs: list[Path]) -> None:
    table = Table(
        "scene",
        "visible",
        "(splat, tile)",
        "step ms",
        "blending ms",
        "rest/blending",
        "ns/visible",
        "peak MiB",
        "of allowed",
        "again MiB",
        title="One step, all threads",
    )
    exponents: list[str] = []
    by_count: dict[int, list[float]] = {}
    for width, height in PICTURES:
        counts, times = [], []
        for n in (1_000, 10_000, 100_000, 1_000_000):
            if n <= largest:
                camera = view(width, height)
                row, seconds = one_row(
                    f"{n:,} at {width}x{height}", random_scene(n, camera), camera
                )
                table.add_row(*row)
                by_count.setdefault(n, []).append(seconds["total"])
                if n >= 10_000:
                    counts.append(float(n))
                    times.append(seconds["total"])
        if len(counts) > 1:
            exponents.append(f"{width}x{height}: {growth(counts, times):.2f}")
    scenes = [(run, side) for run in runs for side in (480, 800)]
    for run, side in scenes:
        splats, camera = trained_scene(run, side)
        name = f"{run.name} at {camera.width}x{camera.height}"
        table.add_row(*one_row(name, splats, camera)[0])
    console.print(table)
    console.print("growth of the step with splats, 10,000 and more: " + ", ".join(exponents))
    pixels = [float(width * height) for width, height in PICTURES]
    console.print(
        "growth of the step with pixels: "
        + ", ".join(f"{n:,} splats: {growth(pixels, t):.2f}" for n, t in by_count.items())
    )


def table_of_kernels(n: int, camera: Camera) -> None:
    pool = TimedPool()
    stepper = Stepper(random_scene(n, camera), camera, pool)
    seconds = kernel_seconds(pool, stepper, rounds_for(stepper))
    table = Table("kernel", "ms", title=f"{n:,} splats at {camera.width}x{camera.height}")
    for name, value in seconds.items():
        if name != "total":
            table.add_row(name, f"{1e3 * value:.2f}")
    others = seconds["total"] - sum(v for k, v in seconds.items() if k != "total")
    table.add_row("sorting, and between kernels", f"{1e3 * others:.2f}")
    table.add_row("step", f"{1e3 * seconds['total']:.2f}")
    console.print(table)


def threads_and_company(n: int, camera: Camera) -> None:
    """One thread, two threads, and two while another process keeps a core busy."""
    scene = random_scene(n, camera)
    one, two = (Stepper(scene, camera, Pool(k)) for k in (1, 2))
    idle = interleaved({"one": one, "two": two}, 15)
    with busy_core():
        busy = interleaved({"two": two}, 15)["two"]
    console.print(
        f"{n:,} splats at {camera.width}x{camera.height}: one thread {1e3 * idle['one']:.1f} ms, "
        f"two {1e3 * idle['two']:.1f} ms; beside a busy process {1e3 * busy:.1f} ms, "
        f"{busy / idle['two']:.2f} times as long"
    )


def against_reference(n: int, camera: Camera) -> None:
    scene = random_scene(n, camera)
    jobs = {
        "kernels": Stepper(scene, camera, Pool()),
        "reference": Stepper(scene, camera, Pool(), backend="reference"),
    }
    taken = interleaved(dict(jobs), 3)
    console.print(
        f"{n:,} splats at {camera.width}x{camera.height}: torch reference with autograd "
        f"{taken['reference']:.2f} s, kernels {1e3 * taken['kernels']:.1f} ms: "
        f"{taken['reference'] / taken['kernels']:.0f} times faster"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=1_000_000, help="splats at most")
    parser.add_argument("--run", type=Path, action="append", default=[], help="trained run folder")
    parser.add_argument("--quick", action="store_true", help="the kernels of two scenes only")
    options = parser.parse_args()
    check_kernels()
    check_step()
    console.print(machine())
    table_of_kernels(37_000, view(480, 319))
    table_of_kernels(100_000, view(960, 540))
    if options.quick:
        return
    threads_and_company(100_000, view(960, 540))
    against_reference(10_000, view(480, 270))
    table_of_sizes(options.largest, options.run)


if __name__ == "__main__":
    main()
