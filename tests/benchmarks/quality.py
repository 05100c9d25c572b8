"""Quality of the presets, and whether a change improves it: `python -m tests.benchmarks.quality
--out FOLDER [CAPTURE ...]`.

For the sample and each given folder of photographs, cameras and seed points are computed once, and
then each preset and seed is trained, pruned and quantised. A folder that holds cameras, such as a
COLMAP scene or a synthetic NeRF scene, is read with them and with its own split if it has one. The
result is evaluated at one size on the same test views: the held-out ones, and for the sample
further ones that its renderer draws. Finished cells are kept in FOLDER, so that a stopped benchmark
can go on.

`--keep FILE` stores the figures, `--against FILE` compares with stored ones: paired
over views and seeds, "better", "worse" or "no significant difference".
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stages import STAGE_NAMES, load_stage
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.cameras.table import read_cameras
from stages.measure.bootstrap import paired_difference
from stages.measure.evaluation import (
    EvaluationView,
    evaluate,
    image_renderer,
    load_evaluation_views,
)
from stages.run.pipeline import Pipeline
from stages.scene import Reconstruction, Splats, draw_settings_of, split_held_out
from stages.sfm import SfmSettings
from stages.train import PRESETS, TrainSettings
from stages.training.build import corrects_light
from tests.benchmarks.sample_test_views import held_out_views_in, render_test_views
from tests.sample import PHOTOS

SAMPLE = "sample"
console = Console(width=150)


@dataclass(frozen=True)
class Cell:
    """One capture, preset and seed. side: of the pictures, pixels. scores: of each view."""

    capture: str
    preset: str
    seed: int
    side: int
    splats: int
    cpu_seconds: float
    wall_seconds: float
    scores: list[dict[str, Any]]


class Capture:
    """Photographs, their cameras and seed points, and the test views."""

    def __init__(self, name: str, photos: Path, out: Path, side: int) -> None:
        self.name, self.folder = name, out / name
        pipeline = Pipeline(self.folder / "run", photos)
        pipeline.run({"sfm": with_its_cameras(photos)}, until="seed")
        self.reconstruction: Reconstruction = pipeline.load("sfm")
        self.seeds: Splats = pipeline.load("seed")
        self.test_views = self._test_views(out, side)

    def _test_views(self, out: Path, side: int) -> tuple[EvaluationView, ...]:
        light = corrects_light(self.reconstruction, TrainSettings().light, Report())
        draw_settings = draw_settings_of(self.reconstruction.views, side, light)
        _, held = split_held_out(self.reconstruction.views)
        found = tuple(load_evaluation_views(self.reconstruction.folder, held, draw_settings))
        if self.name != SAMPLE:
            return found
        render_test_views(out / "test_views")
        return (
            *load_evaluation_views(
                out / "test_views", held_out_views_in(self.reconstruction), draw_settings
            ),
            *found,
        )


def with_its_cameras(photos: Path) -> SfmSettings:
    """How cameras are come by: those that lie with the photographs, else they are searched."""
    try:
        found = read_cameras(photos)
    except SplatError as error:
        if error.code != "cameras-unknown":
            raise
        return SfmSettings()
    split = {"train", "test"} <= {view.role for view in found.views}
    return SfmSettings(cameras=photos, split=split)


def named(folders: Sequence[Path]) -> dict[str, Path]:
    """Each capture by its folder's name, or by its parent's where the name says nothing. Raises
    SystemExit for two of one name, whose cells would be taken for each other's."""
    found = {SAMPLE: PHOTOS}
    for folder in (path.resolve() for path in folders):
        name = folder.parent.name if folder.name in ("images", "photos", "input") else folder.name
        if name in found:
            raise SystemExit(f"{found[name]} and {folder} are both called {name}")
        found[name] = folder
    return found


def measured(capture: Capture, preset: str, seed: int, side: int) -> Cell:
    """Train, prune and quantise, and evaluate the result; kept on disk. What was evaluated at
    another size is evaluated again."""
    folder = capture.folder / f"{preset}-{seed}"
    kept = folder / "cell.json"
    if kept.is_file():
        cell = Cell(**json.loads(kept.read_text(encoding="utf-8")))
        if cell.side != side:
            splats = load_stage("quantise").load(folder / "quantise").splats
            cell = replace(cell, side=side, scores=scores_of(splats, capture.test_views, side))
    else:
        splats, cpu, wall = made(capture, preset, seed, folder)
        found = scores_of(splats, capture.test_views, side)
        cell = Cell(capture.name, preset, seed, side, len(splats), cpu, wall, found)
    kept.write_text(json.dumps(asdict(cell), indent=1), encoding="utf-8")
    return cell


def made(capture: Capture, preset: str, seed: int, folder: Path) -> tuple[Splats, float, float]:
    """(what came out, CPU seconds, wall seconds)."""
    console.print(f"{capture.name}, {preset}, seed {seed}")
    started, cpu = time.monotonic(), _cpu_seconds()
    outputs: dict[str, Any] = {"sfm": capture.reconstruction, "seed": capture.seeds}
    for name in STAGE_NAMES[3:6]:
        stage = load_stage(name)
        settings = stage.settings_type()
        if name == "train":
            settings = replace(PRESETS[preset], seed=seed)
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        outputs[name] = stage.run(outputs, settings, place, Report())
    wall, cpu = time.monotonic() - started, _cpu_seconds() - cpu
    return outputs["quantise"].splats, cpu, wall


def scores_of(
    splats: Splats, test_views: Sequence[EvaluationView], side: int
) -> list[dict[str, Any]]:
    """The scores of each view at a size."""
    draw = image_renderer(
        replace(splats, draw_settings=replace(splats.draw_settings, side=side)), "auto"
    )
    return [asdict(score) for score in evaluate(draw, test_views, with_flip=True)]


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def table_of(cells: list[Cell], side: int) -> Table:
    """One line for each capture and preset: means over seeds and views, the spread over seeds."""
    columns = ("capture", "preset", "seeds", "splats", "CPU s", "wall s", "PSNR dB", "over seeds")
    more = ("worst view", "SSIM", "FLIP")
    table = Table(*columns, *more, title=f"Evaluated at {side} px")
    for (capture, preset), group in grouped(cells).items():
        by_seed = np.array([[row["psnr_db"] for row in cell.scores] for cell in group])
        names = [row["name"] for row in group[0].scores]
        worst = int(by_seed.mean(0).argmin())
        table.add_row(
            capture,
            preset,
            str(len(group)),
            f"{np.mean([cell.splats for cell in group]):,.0f}",
            f"{np.mean([cell.cpu_seconds for cell in group]):.0f}",
            f"{np.mean([cell.wall_seconds for cell in group]):.0f}",
            f"{by_seed.mean():.2f}",
            f"{by_seed.mean(1).std():.2f}",
            f"{by_seed.mean(0)[worst]:.2f} ({names[worst]})",
            f"{np.mean([row['ssim'] for cell in group for row in cell.scores]):.3f}",
            f"{np.mean([row['flip'] for cell in group for row in cell.scores]):.3f}",
        )
    return table


def grouped(cells: list[Cell]) -> dict[tuple[str, str], list[Cell]]:
    """By capture and preset, in order of seeds."""
    found: dict[tuple[str, str], list[Cell]] = {}
    for cell in sorted(cells, key=lambda cell: cell.seed):
        found.setdefault((cell.capture, cell.preset), []).append(cell)
    return found


def compare(now: list[Cell], before: list[Cell]) -> None:
    """A line for each capture and preset that both have, over the seeds that both have. Raises
    SystemExit where they were not evaluated at one size."""
    if sides := {cell.side for cell in [*now, *before]} - {now[0].side}:
        raise SystemExit(
            f"Evaluated at {now[0].side} px, and before at {sides.pop()}: give --side."
        )
    earlier = grouped(before)
    for key, group in grouped(now).items():
        seeds = {cell.seed: cell for cell in earlier.get(key, [])}
        pairs = [(cell, seeds[cell.seed]) for cell in group if cell.seed in seeds]
        if not pairs or any(_names(a) != _names(b) for a, b in pairs):
            continue
        gains = [[_psnr(a, name) - _psnr(b, name) for a, b in pairs] for name in _names(group[0])]
        found = paired_difference(np.array(gains))
        interval = f"{found.low:+.2f} to {found.high:+.2f}"
        console.print(f"{' '.join(key)}: {found.verdict}, {found.mean:+.2f} dB ({interval})")


def _names(cell: Cell) -> list[str]:
    return [row["name"] for row in cell.scores]


def _psnr(cell: Cell, name: str) -> float:
    return next(float(row["psnr_db"]) for row in cell.scores if row["name"] == name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", nargs="*", type=Path, help="folders of photographs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--presets", nargs="+", default=["preview"], choices=list(PRESETS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--side", type=int, default=480, help="of the pictures that are compared, pixels"
    )
    parser.add_argument("--keep", metavar="FILE", type=Path)
    parser.add_argument("--against", metavar="FILE", type=Path)
    given = parser.parse_args()
    cells = []
    for name, photos in named(given.captures).items():
        capture = Capture(name, photos, given.out, given.side)
        for preset in given.presets:
            cells += [measured(capture, preset, seed, given.side) for seed in range(given.seeds)]
            console.print(table_of(cells, given.side))
    if given.keep:
        given.keep.write_text(json.dumps([asdict(c) for c in cells], indent=1), encoding="utf-8")
    if given.against:
        compare(cells, [Cell(**c) for c in json.loads(given.against.read_text(encoding="utf-8"))])


if __name__ == "__main__":
    main()
