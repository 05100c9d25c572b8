"""An asset of the sample drawn at several sizes: `python -m tests.benchmarks.sizes TARGET ...`.

A target is a run folder of the sample, or a file in its export folder. Its splats are drawn from
twelve viewpoints that no photograph was taken from, at each longer side of `--sides`, and compared
with photographs of that size. The table gives the mean and the worst PSNR, dB, of all twelve, of
the ten between the places of the photographs or closer, and of the two from higher up; of a run
also the size of its .ply and the CPU seconds of training.

`--presets preview standard` first processes the sample into a run of each below `--out`, or goes on
with those.

Splats are drawn as they were trained, with `--drawing plain` or `--drawing antialiased` as a viewer
does that does not compensate opacities, or does, and with `--drawing averaged` as `splat render`
does: small pictures larger, then averaged.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from splatcli.folders import load_target
from stages.evaluate.evaluation import EvaluationView, evaluate_at_sizes
from stages.raster.draw import raster_settings_of, renderer, supersampled
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.scene import Splats
from tests import processes, sample
from tests.benchmarks.sample_test_views import HIGHER, PINHOLE, evaluation_views

SIDES = (120, 240, 320, 480, 640)
VIEWS = {"all": slice(None), "between, closer": slice(-HIGHER), "higher": slice(-HIGHER, None)}
DRAWINGS = {"trained": None, "averaged": None, "plain": False, "antialiased": True}


def psnr_at(
    splats: Splats,
    views: Sequence[EvaluationView],
    sides: Sequence[int],
    drawing: str = "trained",
    trained_side: int = 0,
) -> dict[int, list[float]]:
    """PSNR of each view by longer side.

    Args:
        views: at PINHOLE's size, in the world of `splats`.
        drawing: one of DRAWINGS.
        trained_side: longer side of the pictures in training, pixels, for "averaged".
    """
    settings, compensates = raster_settings_of(splats), DRAWINGS[drawing]
    if compensates is not None:
        settings = replace(settings, antialias=compensates)
    draw = renderer(splats, settings)
    if drawing == "averaged":
        draw = supersampled(draw, trained_side)
    sizes = {str(side): side / PINHOLE.width for side in sides}
    found = evaluate_at_sizes(lambda camera: draw(camera).image, views, sizes)
    return {int(side): [score.psnr_db for score in same] for side, same in found.items()}


def processed(out: Path, presets: Sequence[str]) -> list[Path]:
    """Runs of the sample by preset."""
    folders = [out / preset for preset in presets]
    for folder, preset in zip(folders, presets, strict=True):
        words = "process", str(sample.PHOTOS), "--preset", preset, "--out", str(folder)
        subprocess.run(processes.splat(*words), check=True)
    return folders


def costs(target: Path, run: Pipeline) -> tuple[str, str]:
    """Megabytes of the .ply of a run and CPU seconds of its training; blanks for a file."""
    trained, ply = run.manifest("train"), target / "7-export" / "scene.ply"
    size = f"{ply.stat().st_size / 1e6:.1f}" if ply.is_file() else ""
    return size, f"{trained.cpu_seconds:.0f}" if trained and target.is_dir() else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", type=Path)
    parser.add_argument("--presets", nargs="+", default=(), help="of the sample to process first")
    parser.add_argument("--out", type=Path, default=Path("sizes"), help="runs and test views")
    parser.add_argument("--sides", nargs="+", type=int, default=SIDES)
    parser.add_argument("--drawing", nargs="+", choices=list(DRAWINGS), default=["trained"])
    given = parser.parse_args()
    heads = "asset", "splats", "MB", "CPU s", "drawn", "views"
    table = Table(*heads, *(f"{side} px" for side in given.sides))
    for target in [*processed(given.out, given.presets), *given.targets]:
        splats, run = load_target(target)
        run = run or results.run_around(target)
        if run is None:
            raise SystemExit(f"{target} lies in no run: the cameras of the test views are unknown.")
        settings = replace(splats.draw_settings, side=PINHOLE.width)
        views = evaluation_views(given.out / "test_views", run.load("sfm"), settings)
        trained_side = splats.draw_settings.side or results.training_side_of(run)
        for drawing in given.drawing:
            found = psnr_at(splats, views, given.sides, drawing, trained_side)
            for name, chosen in VIEWS.items():
                same = [psnr_db[chosen] for psnr_db in found.values()]
                cells = [f"{np.mean(psnr_db):.2f} / {min(psnr_db):.2f}" for psnr_db in same]
                what = f"{len(splats):,}", *costs(target, run), drawing, name
                table.add_row(str(target), *what, *cells)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
