"""Whether quality depends on how the world lies: `python -m tests.benchmarks.turned --out FOLDER`.

Trains the table in its hall, or with --run the sample, in the worlds of `tests.turned_worlds`, from
the same seeds, and prints PSNR and SSIM of the test views as a table. "0.1 % longer" and the seeds
show how much equal worlds differ. The sample's run is one that ended its seed stage, or later.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.base.stage import Report
from stages.evaluate.evaluation import evaluate, image_renderer, load_evaluation_views
from stages.run.stages import STAGE_OF
from stages.scene import Reconstruction, Splats, draw_settings_of
from stages.seed.settings import SeedSettings
from stages.train.settings import TrainSettings
from tests.benchmarks import table_in_hall
from tests.benchmarks.sample_test_views import held_out_views_in, render_test_views
from tests.turned_worlds import WORLDS, World, in_world, seeds_in_world


@dataclass(frozen=True)
class Prepared:
    """given: what is trained on. tests: the test views, in the same world. seeds: to start from."""

    given: Reconstruction
    tests: Reconstruction
    seeds: Splats


def hall(folder: Path, width: int) -> Prepared:
    """The table in its hall, drawn into `folder`."""
    made = table_in_hall.capture(folder / "images", width)
    given = table_in_hall.of_walk(made)
    inputs, settings = {"sfm": given}, SeedSettings(fill=False)
    seeds: Splats = STAGE_OF["seed"].run(inputs, settings, folder, Report())
    return Prepared(given, replace(made, views=table_in_hall.of_test(made)), seeds)


def sample(run: Path, folder: Path) -> Prepared:
    """The sample's `run`, and its hidden views, drawn into `folder` if they are not there."""
    given: Reconstruction = STAGE_OF["sfm"].load(run / "2-sfm")
    render_test_views(folder / "test_views")
    tests = replace(given, folder=folder / "test_views", views=held_out_views_in(given))
    return Prepared(given, tests, STAGE_OF["seed"].load(run / "3-seed"))


def quality(made: Prepared, world: World, settings: TrainSettings) -> tuple[float, float]:
    """(mean PSNR in dB, mean SSIM) of the test views after training in `world`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = in_world(made.given, world, folder / "given")
        tests = in_world(made.tests, world, folder / "tests")
        inputs = {"sfm": given, "seed": seeds_in_world(made.seeds, world, given)}
        trained: Splats = STAGE_OF["train"].run(inputs, settings, folder, Report()).splats
        drawn = draw_settings_of(given, settings.train_side)
        views = load_evaluation_views(tests.folder, tests.views, drawn)
        scores = evaluate(image_renderer(trained, "auto"), views)
    return float(np.mean([s.psnr_db for s in scores])), float(np.mean([s.ssim for s in scores]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--run", type=Path, help="of the sample; without it, the table in its hall")
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--side", type=int, default=160, help="of the pictures, pixels")
    parser.add_argument("--splats", type=int, default=8000)
    given = parser.parse_args()
    made = sample(given.run, given.out) if given.run else hall(given.out, given.side)
    settings = TrainSettings(
        steps=given.steps, train_side=given.side, sh_degree=1, max_splats=given.splats
    )
    print("| world | PSNR of each seed, dB | mean | SSIM |\n|---|---|--:|--:|")
    for name in given.worlds:
        found = [
            quality(made, WORLDS[name], replace(settings, seed=seed)) for seed in range(given.seeds)
        ]
        each = ", ".join(f"{psnr_db:.2f}" for psnr_db, _ in found)
        psnr_db, ssim = np.mean(found, axis=0)
        print(f"| {name} | {each} | {psnr_db:.2f} | {ssim:.4f} |", flush=True)


if __name__ == "__main__":
    main()
