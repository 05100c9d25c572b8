"""Quality of the presets, and whether a change improves it: `python -m tests.benchmarks.quality
--out FOLDER [--captures FOLDER ...]`.

The sample and the captures of `tests.benchmarks.captures` that the folders hold are measured; which
are missing is said. For each capture cameras and seed points are computed once, and then each
preset and seed is trained, pruned and quantised. Cameras that lie with a capture are used, and its
own split if it has one. The result is evaluated at the full, half and quarter size on the same test
views: the held-out ones, and for the sample further ones that its renderer draws. Finished cells
are kept in FOLDER, so that a stopped benchmark can go on.

`--mode short` takes about ten minutes, `--mode full` (the default) a night. `--keep FILE` stores
the figures, `--against FILE` compares with stored ones: paired over views and seeds within a
capture, and over captures and seeds, "better", "worse" or "no significant difference".
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.cameras.camera_formats import read_cameras
from stages.evaluate.evaluation import (
    SIZES,
    EvaluationView,
    evaluate_at_sizes,
    image_renderer,
    load_evaluation_views,
)
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_NAMES, STAGE_OF
from stages.scene import Reconstruction, Splats, draw_settings_of, split_held_out
from stages.sfm.settings import SfmSettings
from stages.train.build import corrects_light
from stages.train.settings import PRESETS, TrainSettings
from tests.benchmarks.captures import SOURCES, photographs_of
from tests.benchmarks.sample_test_views import evaluation_views
from tests.benchmarks.verdicts import Cell, grouped, read, verdicts, write
from tests.sample import PHOTOS

SAMPLE = "sample"
console = Console(width=150)


@dataclass(frozen=True)
class Mode:
    """What is measured.

    Args:
        captures: of each so many-th photograph, by the capture's name.
        presets: to train with.
        seeds: how many.
        steps: of training instead of the preset's; 0 for those.
    """

    captures: dict[str, int]
    presets: tuple[str, ...]
    seeds: int
    steps: int = 0


MODES = {
    "short": Mode({SAMPLE: 1, "banana": 1, "plush": 4}, ("preview",), 1, 1000),
    "full": Mode(dict.fromkeys((SAMPLE, *SOURCES), 1), ("preview", "standard"), 3),
}


class Capture:
    """Photographs, their cameras and seed points, and the test views."""

    def __init__(self, name: str, photos: Path, out: Path) -> None:
        self.name, self.folder = name, out / name
        self._out = out
        pipeline = Pipeline(self.folder / "run", photos)
        pipeline.run({"sfm": with_its_cameras(photos)}, until="seed")
        self.reconstruction: Reconstruction = pipeline.load("sfm")
        self.seeds: Splats = pipeline.load("seed")

    @cache  # noqa: B019 - a few captures, each with one or two sizes
    def test_views(self, side: int) -> tuple[EvaluationView, ...]:
        """Those with a longer side of at most `side` pixels."""
        choice = TrainSettings().light
        light = corrects_light(self.reconstruction, choice, Report())
        settings = draw_settings_of(self.reconstruction, side, light=light)
        _, held = split_held_out(self.reconstruction.views)
        found = tuple(load_evaluation_views(self.reconstruction.folder, held, settings))
        if self.name != SAMPLE:
            return found
        return (*evaluation_views(self._out / "test_views", self.reconstruction, settings), *found)


def with_its_cameras(photos: Path) -> SfmSettings:
    """How cameras are come by: those that lie with the photographs or beside their folder, else
    they are searched."""
    beside = photos.parent / "transforms.json"
    for place in (photos, beside if beside.is_file() else photos.parent):
        try:
            found = read_cameras(place)
        except SplatError as error:
            if error.code != "cameras-unknown":
                raise
            continue
        split = {"train", "test"} <= {view.role for view in found.views}
        return SfmSettings(cameras=place, split=split)
    return SfmSettings()


def present(mode: Mode, folders: Sequence[Path], out: Path) -> Iterator[tuple[str, Path]]:
    """Name and photographs of each capture of the mode that is there."""
    for name, every in mode.captures.items():
        places = [folder / name for folder in folders if (folder / name).is_dir()]
        if name != SAMPLE and not places:
            console.print(f"{name} is missing: {SOURCES[name].text}")
            continue
        photos = PHOTOS if name == SAMPLE else photographs_of(places[0])
        if every == 1:
            yield name, photos
        else:
            name = f"{name}-{every}"
            yield name, one_in(every, photos, out / name / "photos")


def one_in(every: int, photos: Path, into: Path) -> Path:
    """`into`, with a copy of the first photograph and each `every`-th after it."""
    into.mkdir(parents=True, exist_ok=True)
    for path in sorted(path for path in photos.iterdir() if path.is_file())[::every]:
        if not (into / path.name).exists():
            shutil.copyfile(path, into / path.name)
    return into


def measured(capture: Capture, preset: str, seed: int, steps: int, side: int) -> Cell:
    """Train, prune and quantise, and evaluate the result; kept on disk. What was evaluated at
    another size is evaluated again. steps, side: 0 for the preset's."""
    settings = replace(PRESETS[preset], seed=seed)
    settings = replace(settings, steps=steps or settings.steps)
    side = side or settings.train_side
    folder = capture.folder / f"{preset}-{settings.steps}-{seed}"
    kept = folder / "cell.json"
    if kept.is_file():
        cell = Cell(**json.loads(kept.read_text(encoding="utf-8")))
        if cell.side == side:
            return cell
        splats = STAGE_OF["quantise"].load(folder / "quantise").splats
        cell = replace(cell, side=side, scores=scores_of(splats, capture.test_views(side), side))
    else:
        splats, cpu, wall = made(capture, settings, folder)
        scores = scores_of(splats, capture.test_views(side), side)
        made_with = capture.name, preset, seed, settings.steps, side
        cell = Cell(*made_with, len(splats), cpu, wall, scores)
    kept.write_text(json.dumps(asdict(cell), indent=1), encoding="utf-8")
    return cell


def made(capture: Capture, train: TrainSettings, folder: Path) -> tuple[Splats, float, float]:
    """(what came out, CPU seconds, wall seconds)."""
    console.print(f"{folder}")
    started, cpu = time.monotonic(), _cpu_seconds()
    outputs: dict[str, Any] = {"sfm": capture.reconstruction, "seed": capture.seeds}
    for name in STAGE_NAMES[3:6]:
        stage = STAGE_OF[name]
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        settings = train if name == "train" else stage.settings_type()
        outputs[name] = stage.run(outputs, settings, place, Report())
    wall, cpu = time.monotonic() - started, _cpu_seconds() - cpu
    return outputs["quantise"].splats, cpu, wall


def scores_of(
    splats: Splats, test_views: Sequence[EvaluationView], side: int
) -> dict[str, list[dict[str, Any]]]:
    """The scores of each view by the name of the size; full is `side`."""
    drawn = replace(splats, draw_settings=replace(splats.draw_settings, side=side))
    scores = evaluate_at_sizes(image_renderer(drawn, "auto"), test_views, with_flip=True)
    return {size: [asdict(score) for score in same] for size, same in scores.items()}


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def table_of(cells: list[Cell]) -> Table:
    """One line for each capture and preset: means over seeds and views, the spread over seeds."""
    columns = ("capture", "preset", "px", "seeds", "splats", "CPU s")
    figures = ("PSNR dB", "half", "quarter", "over seeds", "worst view", "SSIM", "FLIP")
    table = Table(*columns, *figures)
    for (preset, capture), group in grouped(cells).items():
        by_size = {
            size: np.array([list(cell.psnr_db(size).values()) for cell in group])
            for size in SIZES
            if size in group[0].scores
        }
        full = by_size["full"]
        worst = int(full.mean(0).argmin())
        rows = [row for cell in group for row in cell.scores["full"]]
        flips = [row["flip"] for row in rows if row["flip"] is not None]
        table.add_row(
            capture,
            preset,
            str(group[0].side),
            str(len(group)),
            f"{np.mean([cell.splats for cell in group]):,.0f}",
            f"{np.mean([cell.cpu_seconds for cell in group]):.0f}",
            *(f"{by_size[s].mean():.2f}" if s in by_size else "-" for s in SIZES),
            f"{full.mean(1).std():.2f}",
            f"{full.mean(0)[worst]:.2f} ({list(group[0].psnr_db('full'))[worst]})",
            f"{np.mean([row['ssim'] for row in rows]):.3f}",
            f"{np.mean(flips):.3f}" if flips else "-",
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mode", default="full", choices=list(MODES))
    parser.add_argument("--captures", type=Path, nargs="+", default=[], help="folders of captures")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="of the mode's")
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS))
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--side", type=int, default=0, help="full size; by default the preset's")
    parser.add_argument("--keep", metavar="FILE", type=Path)
    parser.add_argument("--against", metavar="FILE", type=Path)
    given = parser.parse_args()
    mode = MODES[given.mode]
    if given.only:
        mode = replace(mode, captures={name: mode.captures[name] for name in given.only})
    cells = []
    for name, photos in present(mode, given.captures, given.out):
        capture = Capture(name, photos, given.out)
        for preset in given.presets or mode.presets:
            for seed in range(given.seeds or mode.seeds):
                cells.append(measured(capture, preset, seed, mode.steps, given.side))
            console.print(table_of(cells))
    if given.keep:
        write(given.keep, cells)
    if given.against:
        for line in verdicts(cells, read(given.against)):
            console.print(line)


if __name__ == "__main__":
    main()
