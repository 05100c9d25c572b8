"""gsplat's drawing and backward pass beside ours, on the same scenes, in one process. Its step has
another loss, and is not compared."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np

from tests.device.build_theirs import environment, folder
from tests.device.results import Results, asked

COUNTS = (100_000, 1_000_000, 3_000_000)


def compare(results: Results, toy: bool) -> None:
    import torch

    from stages.raster.definition import splat_arrays
    from stages.raster.gpu.rasteriser import GpuRasteriser
    from tests.benchmarks.gpu import median_ms
    from tests.benchmarks.scenes import view
    from tests.device.made import trained_like
    from tests.device.steps import SETTINGS

    size, rounds = ((32, 24), 1) if toy else ((1280, 800), 15)
    for n in (12,) if toy else COUNTS:
        with results.attempt(f"{n:,} splats"):
            where = view(*size)
            arrays = splat_arrays(trained_like(n, where))
            rasteriser = GpuRasteriser()
            scene, seen = rasteriser.scene(arrays), rasteriser.view(where, SETTINGS)
            room = int(1.5 * len(rasteriser.draw(scene, seen).lists.members)) + 1
            v = torch.randn(3, *size[::-1], device=rasteriser.device)

            draw = partial(rasteriser.draw, scene, seen, capacity=room)
            both = partial(forward_backward, rasteriser, scene, seen, draw, v)
            found = {"draw": median_ms(draw, rounds), "both": median_ms(both, rounds)}
            results.put(f"ours, {n}", found)
            for packed in (False, True):
                with results.attempt(f"gsplat, {n:,}, packed {packed}"):
                    other = theirs(arrays, where, rounds, packed, draw().image)
                    results.put(f"gsplat, {n}, packed {packed}", other)
                    for key in ("draw", "both"):
                        ratio = found[key] / other[key]
                        what = f"{n:,}, {key}, packed {packed}: ours, theirs"
                        value = f"{found[key]:.2f}, {other[key]:.2f} ms, ratio {ratio:.2f}"
                        results.row(what, value, "0.70")
                    results.row("    pictures differ by", f"{other['apart']:.2g}, mean")
        if torch.cuda.is_available():
            torch.cuda.empty_cache()


def forward_backward(rasteriser: Any, scene: Any, seen: Any, draw: Any, v: Any) -> None:
    rasteriser.gradients(scene, seen, draw(), v)


def theirs(arrays: Any, where: Any, rounds: int, packed: bool, image: Any) -> dict[str, float]:
    """Milliseconds; how far its picture is from `image`, in the mean."""
    import gsplat
    import torch

    from tests.benchmarks.gpu import median_ms
    from tests.device.steps import SETTINGS

    on = image.device
    raw = [torch.tensor(np.asarray(a), device=on).requires_grad_() for a in arrays]
    pose = torch.tensor(where.world_to_camera[None], dtype=torch.float32, device=on)
    lens = [[where.fx, 0, where.cx], [0, where.fy, where.cy], [0, 0, 1]]
    lenses = torch.tensor([lens], dtype=torch.float32, device=on)
    v = torch.randn(1, where.height, where.width, 3, device=on)
    degree = int(np.sqrt(arrays[4].shape[1])) - 1

    def draw() -> torch.Tensor:
        shown: torch.Tensor = gsplat.rasterization(
            *(raw[0], raw[1], raw[2].exp(), raw[3].sigmoid(), raw[4], pose, lenses),
            *(where.width, where.height),
            near_plane=SETTINGS.near,
            sh_degree=degree,
            packed=packed,
        )[0]
        return shown

    with torch.no_grad():
        apart = float((draw()[0].permute(2, 0, 1) - image[:3]).abs().mean())
        drawing = median_ms(draw, rounds)
    both = median_ms(lambda: torch.autograd.backward(draw(), v), rounds)
    return {"draw": drawing, "both": both, "apart": apart}


def main() -> None:
    options, results = asked(__doc__, "--bundle")
    if not options.toy and not any(folder().rglob("gsplat_cuda.so")):
        results.row("gsplat", "SKIPPED: it was not built")
        return
    if importlib.util.find_spec("gsplat") is None or "TORCH_EXTENSIONS_DIR" not in os.environ:
        words = [sys.executable, "-m", "tests.device.theirs", *sys.argv[1:]]
        if os.environ.get("SPLAT_THEIRS"):
            results.row("gsplat", "SKIPPED: it cannot be imported")
        else:
            given = {**environment(), "SPLAT_THEIRS": "1"}
            sys.exit(subprocess.run(words, env=given).returncode)
        return
    compare(results, options.toy)


if __name__ == "__main__":
    main()
