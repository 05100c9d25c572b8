"""How fast the GPU backend is: `python -m tests.benchmarks.gpu`, on a machine with a GPU.

First the gate: pictures and gradients are the reference's, or nothing is timed. Then scenes of
100,000, 1,000,000 and 5,000,000 splats at 1080p and 4K: drawing, backward pass, both, a whole
training step, each the median of many by the device's own clock; what share of the device's
bandwidth a step makes use of; memory a splat; gsplat on the same scene in the same process, packed
and not, where it can be imported (its step with the same loss in torch, and torch's fused Adam).
`--toy` runs all of it on a few splats, by Triton's interpreter where there is no GPU: its times
mean nothing.

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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from stages.raster.definition import MemoryFull, RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.raster.gpu import device
from stages.raster.gpu.rasteriser import DeviceScene, DeviceView, GpuRasteriser
from stages.scene import Camera, Splats
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, new_model
from stages.train.steps.gpu import GpuStep
from stages.train.steps.reference import reference_loss
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.benchmarks.scenes import random_scene, view
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

SCENES = tuple(
    (n, s) for n in (100_000, 1_000_000, 5_000_000) for s in ((1920, 1080), (3840, 2160))
)
TOY = ((12, (32, 24)),)
H100_BYTES_A_SECOND = 3.35e12  # what the floor is of, whatever the device
COLUMNS = ("draw_ms", "back_ms", "both_ms", "step_ms", "frames_a_second", "floor_ms", "floor_share")
# Of a step, by docs/experiments/gpu.md: what a splat, a (splat, tile) and a pixel move.
STEP_BYTES = (3437, 328, 326)
SETTINGS = RasterSettings(near=1e-5)
ON = "cuda" if torch.cuda.is_available() else "cpu"


def gate() -> None:
    """Exit with what differs from the reference, if anything does."""
    scene, where = cloud(30, 24, 20, degree=1), camera(24, 20)
    pictures = [render(scene, where, backend=name).image for name in ("gpu", "reference")]
    off = float(np.abs(pictures[0] - pictures[1]).max())
    if not off <= FLOAT32_IMAGE:
        sys.exit(f"gate: picture: off by {off:.2g}")
    v = np.random.default_rng(0).normal(size=(20, 24, 3))
    found, wanted = gradients("gpu", scene, where, v), exact_gradients(scene, where, v)
    for name in PARAMETERS:
        off = relative(found[name], wanted[name])
        if not off <= FLOAT32_GRADIENT:
            sys.exit(f"gate: gradient of {name}: off by {off:.2g}")
    print("gate: pictures and gradients agree with the reference")


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
    """Milliseconds of drawing, both ways, a step and its floor; entries of the lists; bytes a
    splat of a step."""
    rasteriser = GpuRasteriser()
    scene, seen = rasteriser.scene(splat_arrays(splats)), rasteriser.view(where, SETTINGS)
    entries = len(rasteriser.draw(scene, seen).lists.members)
    v = torch.randn(3, where.height, where.width, device=rasteriser.device)
    found = {"entries": float(entries)}
    found["draw_ms"] = median_ms(lambda: rasteriser.draw(scene, seen, capacity=entries), rounds)
    found["both_ms"] = median_ms(lambda: _both(rasteriser, scene, seen, entries, v), rounds)
    stepper, level = GpuStep(rasteriser), stripes(where)
    stepper.load(new_model(*(a.copy() for a in splat_arrays(splats))))
    rates = LearningRates().scaled(0.0, 0.0)  # so that the scene stays what it is
    found |= _step(lambda: stepper.step(StepInput(level, SETTINGS, rates)), rounds, len(splats))
    moved = np.dot(STEP_BYTES, (len(splats), entries, where.width * where.height))
    found["floor_ms"] = 1e3 * float(moved) / H100_BYTES_A_SECOND
    found["floor_share"] = found["floor_ms"] / found["step_ms"]
    return found


def _step(work: Callable[[], Any], rounds: int, splats: int) -> dict[str, float]:
    """Milliseconds of a step, and the most bytes a splat that there were meanwhile."""
    if not torch.cuda.is_available():
        return {"step_ms": median_ms(work, rounds)}
    torch.cuda.reset_peak_memory_stats()
    taken = median_ms(work, rounds)
    return {"step_ms": taken, "bytes_a_splat": torch.cuda.max_memory_allocated() / splats}


def _both(
    rasteriser: GpuRasteriser, scene: DeviceScene, seen: DeviceView, entries: int, v: Any
) -> None:
    drawn = rasteriser.draw(scene, seen, capacity=entries)
    rasteriser.gradients(scene, seen, drawn, v)


def theirs(splats: Splats, where: Camera, rounds: int, packed: bool) -> dict[str, float]:
    """The same of gsplat: its rasteriser, the loss in torch, torch's fused Adam."""
    import gsplat

    def tensor(array: Any) -> torch.Tensor:
        return torch.tensor(np.asarray(array, np.float32), device=ON).requires_grad_()

    raw = [tensor(a) for a in splat_arrays(splats)]
    pose = torch.tensor(where.world_to_camera[None], dtype=torch.float32, device=ON)
    lens = [[where.fx, 0, where.cx], [0, where.fy, where.cy], [0, 0, 1]]
    v = torch.randn(1, where.height, where.width, 3, device=ON)

    def draw() -> torch.Tensor:
        image: torch.Tensor = gsplat.rasterization(
            *(raw[0], raw[1], raw[2].exp(), raw[3].sigmoid(), raw[4], pose),
            torch.tensor([lens], dtype=torch.float32, device=ON),
            *(where.width, where.height),
            near_plane=SETTINGS.near,
            sh_degree=splats.sh_degree,
            packed=packed,
        )[0]
        return image

    def both() -> None:
        torch.autograd.backward(draw(), v)

    target = torch.rand(3, where.height, where.width, device=ON)
    adam = torch.optim.Adam(raw, lr=0.0, fused=True)

    def step() -> None:
        adam.zero_grad()
        torch.autograd.backward(reference_loss(draw()[0].permute(2, 0, 1), target))
        adam.step()

    with torch.no_grad():
        found = {"draw_ms": median_ms(draw, rounds)}
    found["both_ms"] = median_ms(both, rounds)
    found |= _step(step, rounds, len(splats))
    return found


def measure(scenes: tuple[Any, ...], rounds: int) -> list[dict[str, Any]]:
    """One line for each scene and each program; "failed" where there was no room."""
    lines: list[dict[str, Any]] = []
    for n, (width, height) in scenes:
        where = view(width, height)
        splats = random_scene(n, where, degree=3)
        for program, work in programs().items():
            line = {"splats": n, "width": width, "height": height, "program": program}
            try:
                line |= work(splats, where, rounds)
                line["back_ms"] = line["both_ms"] - line["draw_ms"]
                line["frames_a_second"] = 1e3 / line["draw_ms"]
            except (MemoryFull, torch.OutOfMemoryError) as error:
                line["failed"] = str(error).splitlines()[0]
            lines.append(line)
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
    return lines


def programs() -> dict[str, Callable[[Splats, Camera, int], dict[str, float]]]:
    """Ours, and gsplat where it can be imported and there is a GPU to run it."""
    found: dict[str, Any] = {"splat": ours}
    if importlib.util.find_spec("gsplat") and torch.cuda.is_available():
        found["gsplat"] = partial(theirs, packed=False)
        found["gsplat, packed"] = partial(theirs, packed=True)
    return found


def show(lines: list[dict[str, Any]]) -> None:
    """The table."""
    table = Table("splats", "picture", "program", *(c.replace("_", " ") for c in COLUMNS), "bytes")
    for line in lines:
        what = (f"{line['splats']:,}", f"{line['width']}x{line['height']}", line["program"])
        cells = ("-" if c not in line else f"{line[c]:,.2f}" for c in COLUMNS)
        size = f"{line['bytes_a_splat']:,.0f} a splat" if "bytes_a_splat" in line else "-"
        table.add_row(*what, *cells, line.get("failed", size))
    console = Console(width=160)
    console.print(device.describe())
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--toy", action="store_true", help="a few splats, also without a GPU")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    asked = parser.parse_args()
    device.require()
    gate()
    lines = measure(TOY if asked.toy else SCENES, asked.rounds)
    asked.out.write_text(json.dumps({"device": device.describe(), "lines": lines}, indent=2))
    show(lines)


if __name__ == "__main__":
    main()
