"""How fast the CPU rasteriser draws and differentiates: `python -m tests.benchmarks.raster`.

Nothing is timed before pictures and gradients agree with the reference. All ratios are of medians
of rounds interleaved in this run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import Camera, Splats
from tests.benchmarks.gate import check_kernels
from tests.benchmarks.scenes import PICTURES, equal_scene, random_scene, trained_scene, view
from tests.benchmarks.timing import TimedPool, interleaved, kernel_seconds, machine, rounds_for
from tests.benchmarks.yardstick import Yardstick
from tests.tolerances import FLOAT32_IMAGE

# milliseconds, one thread, forward and backward: 20 times faster than OpenSplat 1.1.5 on a CPU
EQUAL = {(1_000, 256): None, (10_000, 256): None, (10_000, 512): 17.0, (100_000, 512): 35.0}
console = Console(width=170)


def check_pictures(name: str, found: np.ndarray, wanted: np.ndarray) -> None:
    """Exit unless the yardstick drew the same; where alpha is a rounding away from 1/255 a splat
    may be there or not."""
    off = np.abs(found - wanted)
    if off.max() > 1.0 / 255 or (off > FLOAT32_IMAGE).mean() > 1e-4:
        raise SystemExit(f"gate: the yardstick's picture of {name} is off by {off.max():.2g}")


def measure(name: str, splats: Splats, camera: Camera, yardstick: Yardstick) -> list[str]:
    """One row of the table."""
    pool = TimedPool()
    rasteriser = CpuRasteriser(pool)
    arrays, settings = splat_arrays(splats), RasterSettings()
    v = np.random.default_rng(0).normal(size=(3, camera.height, camera.width)).astype(np.float32)

    def forward() -> None:
        rasteriser.forward(arrays, camera, settings)

    def both() -> None:
        rasteriser.backward(rasteriser.forward(arrays, camera, settings), v)

    drawn = rasteriser.forward(arrays, camera, settings)
    visible, intersections = len(drawn.visible), drawn.n_intersections
    image = np.empty_like(drawn.image)
    cpp = yardstick.blend(pool, drawn, image)
    cpp()
    check_pictures(name, image, drawn.image)
    rounds = rounds_for(both)
    blends: dict[str, list[float]] = {"ours": [], "cpp": []}
    for _ in range(rounds):
        pool.seconds.clear()
        forward()
        blends["ours"].append(pool.seconds["blend_tiles"])
        blends["cpp"].append(interleaved({"cpp": cpp}, 1)["cpp"])
    ours, theirs = (float(np.median(blends[k])) for k in ("ours", "cpp"))
    seconds = kernel_seconds(pool, both, rounds)
    back = seconds["blend_gradient_tiles"]
    return [
        name,
        f"{visible:,}",
        f"{intersections:,}",
        f"{1e3 * interleaved({'f': forward}, rounds)['f']:.1f}",
        f"{1e3 * seconds['total']:.1f}",
        f"{1e3 * ours:.2f}",
        f"{ours / theirs:.2f}",
        f"{back / ours:.2f}",
        f"{1e9 * ours / max(intersections, 1):.1f}",
        f"{1e9 * back / max(intersections, 1):.1f}",
        f"{1e9 * (seconds['total'] - ours - back) / max(visible, 1):.0f}",
    ]


def sizes(largest: int, runs: list[Path]) -> None:
    table = Table(
        "scene",
        "visible",
        "(splat, tile)",
        "forward ms",
        "both ms",
        "blend ms",
        "of C++",
        "back/fwd",
        "ns/entry fwd",
        "ns/entry back",
        "rest ns/splat",
        title="Forward and backward, all threads",
    )
    yardstick = Yardstick()
    for width, height in PICTURES:
        for n in (1_000, 10_000, 100_000, 1_000_000):
            if n <= largest:
                camera = view(width, height)
                name = f"{n:,} at {width}x{height}"
                table.add_row(*measure(name, random_scene(n, camera), camera, yardstick))
    for run in runs:
        for side in (480, 960):
            splats, camera = trained_scene(run, side)
            name = f"{run.name} at {camera.width}x{camera.height}"
            table.add_row(*measure(name, splats, camera, yardstick))
    console.print(table)


def equal_comparison() -> None:
    """One thread, projection included."""
    table = Table(
        "splats", "picture", "ms", "target ms", title="The equal comparison: one thread, both ways"
    )
    for (n, side), target in EQUAL.items():
        splats, camera, v = equal_scene(n, side)
        rasteriser, arrays = CpuRasteriser(TimedPool(1)), splat_arrays(splats)
        settings = RasterSettings(sh_degree=0)

        def both(r=rasteriser, a=arrays, c=camera, s=settings, v=v) -> None:
            r.backward(r.forward(a, c, s), v)

        seconds = interleaved({"both": both}, rounds_for(both))["both"]
        wanted = "" if target is None else f"{target:.0f}"
        table.add_row(f"{n:,}", f"{side}x{side}", f"{1e3 * seconds:.1f}", wanted)
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=1_000_000, help="splats at most")
    parser.add_argument("--run", type=Path, action="append", default=[], help="trained run folder")
    options = parser.parse_args()
    check_kernels()
    console.print(machine())
    equal_comparison()
    sizes(options.largest, options.run)


if __name__ == "__main__":
    main()
