"""Pictures and every gradient of random scenes at odd sizes, and of hostile ones, against float64
by autograd through the definition; with --large, of a large scene against the CPU's kernels.

What is beyond its bound is measured with the CPU's kernels, too: theirs are the bounds to hold."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from stages.raster.backends import rasteriser_of
from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import Camera, Splats
from tests.device.made import odd_scenes, trained_like
from tests.device.results import Results, asked
from tests.scenes import PARAMETERS, camera, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

SECONDS = 85.0
SCENES = 400


def settings_of(number: int) -> RasterSettings:
    return RasterSettings(
        background=(0.2, 0.5, 0.9), antialias=bool(number & 1), sh_degree=number // 2 % 4
    )


def errors(
    backend: str, scene: Splats, view: Camera, settings: RasterSettings, seed: int
) -> dict[str, float]:
    """Of the picture (absolute) and of each gradient (relative to its largest)."""
    arrays = splat_arrays(scene)
    v = np.random.default_rng(seed).normal(size=(view.height, view.width, 3))
    image = rasteriser_of(backend).forward(arrays, view, settings).image[:3]
    wanted = rasteriser_of("reference").forward(arrays, view, settings).image[:3]
    found = {"picture": float(np.abs(image - wanted).max(initial=0.0))}
    ours = gradients(backend, scene, view, v, settings)
    exact = exact_gradients(scene, view, v, settings)
    for name in PARAMETERS:
        here, there = np.asarray(ours[name], np.float64), np.nan_to_num(exact[name])
        found[name] = relative(here, there) if np.isfinite(here).all() else np.inf
    return found


def beyond(found: dict[str, float]) -> dict[str, float]:
    """Those that are not within their bounds."""
    return {
        name: value
        for name, value in found.items()
        if not value <= (FLOAT32_IMAGE if name == "picture" else FLOAT32_GRADIENT)
    }


def small(results: Results, first: int, toy: bool) -> None:
    ends = time.monotonic() + (1e9 if toy else SECONDS)
    worst: dict[str, float] = {}
    bad: dict[str, Any] = {}
    done = 0
    for number, (name, scene, view) in enumerate(odd_scenes(first, toy), first):
        if done >= (3 if toy else SCENES) or time.monotonic() > ends:
            break
        settings = settings_of(number)
        with results.attempt(name):
            found = errors("gpu", scene, view, settings, number)
            worst = {k: max(v, worst.get(k, 0.0)) for k, v in found.items()}
            if wrong := beyond(found):
                theirs = errors("cpu", scene, view, settings, number)
                bad[name] = {k: (v, theirs[k]) for k, v in wrong.items()}
                # a hostile scene may be beyond both
                if any(not v <= 2.0 * theirs[k] for k, v in wrong.items()):
                    results.row(f"BEYOND {name}", str(bad[name]))
        done += 1
        results.put("worst", worst)
        results.put("beyond", bad)
    results.row("scenes against float64", f"{done}, {len(bad)} beyond the plain bounds")
    for name, value in worst.items():
        bound = FLOAT32_IMAGE if name == "picture" else FLOAT32_GRADIENT
        results.row(f"largest error of {name}", f"{value:.2g}", f"{bound:.2g}")
    same_twice(results, toy)


def same_twice(results: Results, toy: bool) -> None:
    """Whether the same scene gives the same bytes twice, in one process."""
    n, size = (20, (24, 16)) if toy else (200_000, (960, 540))
    view = camera(*size, focal=size[0])
    arrays = splat_arrays(trained_like(n, view))
    v = np.random.default_rng(1).normal(size=(3, size[1], size[0])).astype(np.float32)
    made = []
    for _ in range(2):
        rasteriser = rasteriser_of("gpu")
        forward = rasteriser.forward(arrays, view, RasterSettings())
        backward = rasteriser.backward(forward, v)
        made.append((forward.image.tobytes(), backward.parameters.tobytes()))
    results.row(f"the same bytes twice, {n:,} splats", "yes" if made[0] == made[1] else "NO", "yes")


def large(results: Results, toy: bool) -> None:
    """Against the CPU's kernels, whose sums have other orders."""
    n, size = (30, (24, 16)) if toy else (300_000, (1280, 720))
    view = camera(*size, focal=size[0])
    scene = trained_like(n, view)
    v = np.random.default_rng(1).normal(size=(size[1], size[0], 3)).astype(np.float32)
    arrays, settings = splat_arrays(scene), RasterSettings(background=(0.1, 0.2, 0.3))
    images = [rasteriser_of(b).forward(arrays, view, settings).image for b in ("gpu", "cpu")]
    off = np.abs(images[0][:3] - images[1][:3])
    results.row("picture against the CPU's", f"{off.max():.2g}, mean {off.mean():.2g}", "4e-3")
    found = [gradients(b, scene, view, v, settings) for b in ("gpu", "cpu")]
    for name in PARAMETERS:
        apart = relative(found[0][name], found[1][name])
        results.row(f"gradient of {name} against the CPU's", f"{apart:.2g}", "1e-4")


def main() -> None:
    options, results = asked(__doc__, "--first", "--large")
    torch.set_num_threads(4)
    if options.large:
        large(results, options.toy)
    else:
        small(results, int(options.first or 0), options.toy)


if __name__ == "__main__":
    main()
