"""How fast the GPU backend is: `python -m tests.benchmarks.gpu`, on a machine with a GPU.

First the gate: pictures and gradients are the reference's, or nothing is timed. Then scenes of
100,000, 1,000,000 and 5,000,000 splats at 1080p and 4K: drawing, drawing and the way back, a whole
training step, each the median of many by the device's own clock; memory a splat; gsplat on the same
scene in the same process, packed and not, where it can be imported. `--toy` runs all of it on a
few splats, by Triton's interpreter where there is no GPU: its times mean nothing.

One table on the screen, one JSON beside it (--out).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.gpu import device
from stages.raster.gpu.rasteriser import GpuRasteriser, Scene, View
from stages.scene import Camera, Splats
from stages.training.gpu_step import GpuStep
from stages.training.loss import channel_means
from stages.training.optimiser import LearningRates, new_model
from stages.training.views import Level
from tests.benchmarks.scenes import random_scene, view
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT

SCENES = tuple(
    (n, s) for n in (100_000, 1_000_000, 5_000_000) for s in ((1920, 1080), (3840, 2160))
)
TOY = ((12, (32, 24)),)
H100_BYTES_A_SECOND = 3.35e12
# Of a step, by docs/gpu.md: what a splat, a (splat, tile) and a pixel move.
STEP_BYTES = (3437, 328, 326)
SETTINGS = RasterSettings(near=1e-5)


def gate() -> None:
    """Exit with what differs from the reference, if anything does."""
    scene, where = cloud(30, 24, 20, degree=1), camera(24, 20)
    v = np.random.default_rng(0).normal(size=(20, 24, 3))
    found, wanted = gradients("gpu", scene, where, v), exact_gradients(scene, where, v)
    for name in PARAMETERS:
        off = relative(found[name], wanted[name])
        if not off <= FLOAT32_GRADIENT:
            sys.exit(f"gate: gradient of {name}: off by {off:.2g}")
    print("gate: gradients agree with the reference")


def median_ms(work: Callable[[], Any], rounds: int) -> float:
    """Of one call, by the device's clock where there is one; once unmeasured first."""
    work()
    if not torch.cuda.is_available():
        start = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - start)
    spent = []
    for _ in range(rounds):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        end.synchronize()
        spent.append(begin.elapsed_time(end))
    return statistics.median(spent)


def stripes(camera: Camera) -> Level:
    """A photograph with something to fit that is not noise."""
    r = np.random.default_rng(1)
    pixels = r.integers(0, 256, (3, camera.height, camera.width)).astype(np.uint8)
    pixels[:] = pixels.mean(2, keepdims=True)
    return Level(camera, pixels, channel_means(pixels))


def ours(splats: Splats, where: Camera, rounds: int) -> dict[str, float]:
    """Milliseconds of drawing, of both ways, of a step; entries of the lists; bytes a splat."""
    rasteriser = GpuRasteriser()
    scene, seen = rasteriser.scene(splat_arrays(splats)), rasteriser.view(where, SETTINGS)
    entries = len(rasteriser.draw(scene, seen).lists.members)
    v = torch.randn(3, where.height, where.width, device=rasteriser.device)
    found = {"entries": float(entries)}
    found["draw_ms"] = median_ms(lambda: rasteriser.draw(scene, seen, capacity=entries), rounds)
    found["both_ms"] = median_ms(lambda: _both(rasteriser, scene, seen, entries, v), rounds)
    stepper, level = GpuStep(rasteriser), stripes(where)
    stepper.load(new_model(*(a.copy() for a in splat_arrays(splats))))
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    rates = LearningRates().scaled(0.0, 0.0)  # so that the scene stays what it is
    found["step_ms"] = median_ms(lambda: stepper.step(level, SETTINGS, rates, False), rounds)
    if torch.cuda.is_available():
        found["bytes_a_splat"] = torch.cuda.max_memory_allocated() / len(splats)
    moved = np.dot(STEP_BYTES, (len(splats), entries, where.width * where.height))
    found["bandwidth_floor_ms"] = 1e3 * float(moved) / H100_BYTES_A_SECOND
    return found


def _both(rasteriser: GpuRasteriser, scene: Scene, seen: View, entries: int, v: Any) -> None:
    drawn = rasteriser.draw(scene, seen, capacity=entries)
    rasteriser.gradients(scene, seen, drawn, v)


def theirs(splats: Splats, where: Camera, rounds: int, packed: bool) -> dict[str, float]:
    """The same of gsplat, as far as it goes: drawing, and both ways."""
    import gsplat

    def tensor(array: Any) -> torch.Tensor:
        return torch.tensor(np.asarray(array, np.float32), device="cuda").requires_grad_()

    raw = [tensor(a) for a in splat_arrays(splats)]
    pose = torch.tensor(where.world_to_camera[None], dtype=torch.float32, device="cuda")
    lens = [[where.fx, 0, where.cx], [0, where.fy, where.cy], [0, 0, 1]]
    v = torch.randn(1, where.height, where.width, 3, device="cuda")

    def draw() -> torch.Tensor:
        image: torch.Tensor = gsplat.rasterization(
            *(raw[0], raw[1], raw[2].exp(), raw[3].sigmoid(), raw[4], pose),
            torch.tensor([lens], dtype=torch.float32, device="cuda"),
            *(where.width, where.height),
            near_plane=SETTINGS.near,
            sh_degree=splats.sh_degree,
            packed=packed,
        )[0]
        return image

    def both() -> None:
        torch.autograd.backward(draw(), v)

    with torch.no_grad():
        drawing = median_ms(draw, rounds)
    return {"draw_ms": drawing, "both_ms": median_ms(both, rounds)}


def measure(scenes: tuple[Any, ...], rounds: int) -> list[dict[str, Any]]:
    """One line for each scene and each program."""
    lines: list[dict[str, Any]] = []
    for n, (width, height) in scenes:
        where = view(width, height)
        splats = random_scene(n, where, degree=3)
        what = {"splats": n, "width": width, "height": height}
        lines.append({**what, "program": "splat", **ours(splats, where, rounds)})
        if importlib.util.find_spec("gsplat") and torch.cuda.is_available():
            for packed in (False, True):
                name = "gsplat, packed" if packed else "gsplat"
                lines.append({**what, "program": name, **theirs(splats, where, rounds, packed)})
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--toy", action="store_true", help="a few splats, also without a GPU")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    asked = parser.parse_args()
    device.require()
    gate()
    lines = measure(TOY if asked.toy else SCENES, asked.rounds)
    asked.out.write_text(json.dumps({"device": device.told(), "lines": lines}, indent=2))
    columns = ("splats", "width", "height", "program", "draw_ms", "both_ms", "step_ms")
    table = Table(*columns, "frames a second", "bandwidth floor ms", "bytes a splat")
    for line in lines:
        cells = [str(line[c]) if c in columns[:4] else f"{line.get(c, 0):.2f}" for c in columns]
        rest = (1e3 / line["draw_ms"], line.get("bandwidth_floor_ms"), line.get("bytes_a_splat"))
        table.add_row(*cells, *("-" if x is None else f"{x:,.1f}" for x in rest))
    console = Console(width=150)
    console.print(device.told())
    console.print(table)


if __name__ == "__main__":
    main()
