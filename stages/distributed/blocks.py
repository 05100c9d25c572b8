"""Training of a large scene in blocks.

1. A coarse model of the whole scene is trained. It says which views show each block, and is the
   background while a block is trained.
2. Each block is trained by an executor, in a run folder of its own under `blocks/`.
3. The splats of each block that lie in its cell are merged, and the seams between blocks are
   fine-tuned on the views that cross them.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import UsageError
from stages.base.stage import Numbers, Report, Stage
from stages.base.text import counted
from stages.distributed import block_folders, merge, partition
from stages.distributed.partition import Cell
from stages.distributed.tasks import Executor, OpenExecutor, RunTask, resources_of, run_all
from stages.evaluate.evaluation import image_renderer, load_evaluation_views
from stages.evaluate.verdict import WRONG, Verdict
from stages.run.listener import Listener
from stages.run.pipeline import Pipeline
from stages.scene import (
    DrawSettings,
    Reconstruction,
    Splats,
    TrainedSplats,
    View,
    draw_settings_of,
    split_held_out,
    training_extent,
)
from stages.train import transients
from stages.train.build import corrects_light, most_steps_for
from stages.train.dropout import uses_dropout
from stages.train.finetune import FineTuner
from stages.train.history import History
from stages.train.quality import report_verdict, write_history, write_quality
from stages.train.settings import TrainSettings
from stages.train.stage import save

FOLDER, COARSE = "blocks", "coarse"
VIEWS_PER_BLOCK = 250
# Divisors of the settings for the coarse model; it has no more splats than one of the blocks.
COARSE_STEPS, COARSE_SIDE, COARSE_SPLATS = 3, 2, 4


def in_blocks(pipeline: Pipeline, open_executor: OpenExecutor) -> Pipeline:
    """The pipeline, which trains in blocks if its settings ask for it."""
    stage = pipeline.layout.stage("train")

    def train(
        inputs: Mapping[str, Any], settings: TrainSettings, folder: Path, report: Report
    ) -> Any:
        single = replace(settings, blocks="1")
        views = 0 if settings == single else len(inputs["sfm"].views)
        blocks = count_blocks(settings.blocks, views)
        if blocks == 1:
            return stage.run(inputs, single, folder, report)
        check_settings(settings)
        root = pipeline.run_folder.absolute() / FOLDER
        root.mkdir(exist_ok=True)
        whole = _with_roles(inputs["sfm"])
        with open_executor(root, _BlockProgress(report)) as executor:
            training = _BlockTraining(pipeline, whole, single, root, executor, report)
            return training.train(blocks, inputs["seed"], folder)

    return pipeline.with_run("train", train)


def count_blocks(setting: str, views: int) -> int:
    """The number of blocks for `TrainSettings.blocks` and this many views."""
    return max(1, round(views / VIEWS_PER_BLOCK)) if setting == "auto" else int(setting)


@dataclass
class _BlockTraining:
    """The training of one scene in blocks.

    whole: the scene, whose views have the same roles in all blocks. settings: of the whole scene.
    root: the folder of the blocks' run folders.
    """

    pipeline: Pipeline
    whole: Reconstruction
    settings: TrainSettings
    root: Path
    executor: Executor
    report: Report

    def train(self, blocks: int, seeds: Splats, folder: Path) -> TrainedSplats:
        """The merged splats, written to `folder` as training writes them."""
        light = corrects_light(self.whole, self.settings.light, self.report)
        if not light:
            views = tuple(replace(view, light=None) for view in self.whole.views)
            self.whole = replace(self.whole, views=views)
        self.settings = replace(self.settings, light="auto" if light else "off")
        coarse = self._coarse(seeds, max(blocks, COARSE_SPLATS))
        training, held = split_held_out(self.whole.views)
        points, weights = partition.weighted_points(replace(self.whole, views=training))
        cells = partition.partition(points, weights, blocks)
        cameras = [view.camera for view in self.whole.views]
        backend = self.settings.backend
        fractions = partition.block_fractions(coarse, cells, cameras, backend)
        assigned = partition.assign_views(fractions)
        folders = self._blocks(seeds, coarse, cells, assigned, partition.margin(points))
        parts = self._parts(folders, cells, assigned)
        steps, masks = self._course(folders, folder)
        self.whole = self.whole.with_masks(masks)
        training, held = split_held_out(self.whole.views)
        draw_settings = draw_settings_of(
            self.whole, self.settings.train_side, light, self.settings.antialias
        )
        crosses = partition.crosses_blocks(assigned)
        crossing = [v for v, across in zip(self.whole.views, crosses, strict=True) if across]
        seam_views = [view for view in crossing if view in training]
        trained = self._merge(parts, cells, seam_views, draw_settings, len(training))
        verdict = self._evaluate(trained.splats, held, folder)
        wrong = verdict.grade == WRONG and self.whole.contradicted
        trained = replace(trained, contradicted=wrong, steps=steps, masks=masks)
        save(folder, trained)
        self.report.metric("training_views", len(training))
        self.report.metric("held_out_views", len(held))
        self.report.metric("views_across_blocks", [view.name for view in crossing])
        return trained

    def _evaluate(self, splats: Splats, held: Sequence[View], folder: Path) -> Verdict:
        settings = splats.draw_settings
        views = load_evaluation_views(self.whole.folder, held, settings)
        render = image_renderer(splats, self.settings.backend)
        write_quality(render, views, settings, self.whole, folder, self.report)
        write_history(History(), folder, self.report)
        return report_verdict(splats, views, self.whole, self.settings.backend, self.report)

    def _coarse(self, seeds: Splats, fewer: int) -> Splats:
        views = len(split_held_out(self.whole.views)[0])
        steps = self.settings.steps or most_steps_for(self.settings.steps_per_view, views)
        settings = replace(
            self.settings,
            steps=-(-steps // COARSE_STEPS),
            train_side=max(16, self.settings.train_side // COARSE_SIDE),
            max_splats=max(1, self.settings.max_splats // fewer),
            splats_per_view=0,
        )
        block_folders.begin(self.pipeline, self.root / COARSE, self.whole, seeds, settings)
        self._run([COARSE], settings.max_splats)
        return self._trained(COARSE).splats

    def _blocks(
        self,
        seeds: Splats,
        coarse: Splats,
        cells: Sequence[Cell],
        assigned: NDArray[np.bool_],
        margin: float,
    ) -> list[str]:
        """Train the blocks. Returns the name of each cell's run folder: the coarse model's for a
        cell that no training view shows."""
        folders, largest = [], 0
        for number, (cell, chosen) in enumerate(zip(cells, assigned, strict=True), start=1):
            views = tuple(v for v, own in zip(self.whole.views, chosen, strict=True) if own)
            folders.append(COARSE)
            if any(view.role != "test" for view in views):
                folders[-1] = str(number)
                part, wide = replace(self.whole, views=views), cell.widened(margin)
                largest = max(largest, self._begin(str(number), part, seeds, coarse, wide))
        empty = [str(n) for n, folder in enumerate(folders, start=1) if folder == COARSE]
        if empty:
            self.report.warn(
                "train-blocks-unseen",
                f"No photograph shows {counted(len(empty), 'block')} of {len(cells)} "
                f"({', '.join(empty)}): the coarse model stands there. Ask for fewer --blocks.",
            )
        for path in self.root.iterdir():  # of an earlier partition into more blocks
            if path.name.isdigit() and path.name not in folders:
                shutil.rmtree(path)
        self._run([folder for folder in folders if folder != COARSE], largest)
        return folders

    def _parts(
        self, folders: Sequence[str], cells: Sequence[Cell], assigned: NDArray[np.bool_]
    ) -> list[Splats]:
        """The splats of each block in its cell, together at most the maximum of the scene. Only one
        block at a time is in memory as a whole."""
        parts: list[Splats] = []
        facts = []
        counts = [
            int(cell.holds(self._trained(folder).splats.means).sum())
            for folder, cell in zip(folders, cells, strict=True)
        ]
        kept_fraction = min(1.0, self.settings.max_splats / max(1, sum(counts)))
        for number, (folder, cell, chosen) in enumerate(zip(folders, cells, assigned, strict=True)):
            splats = self._trained(folder).splats
            views = tuple(v for v, shows in zip(self.whole.views, chosen, strict=True) if shows)
            own = self._own(splats, cell, int(kept_fraction * counts[number]), views)
            parts.append(splats.take(own))
            facts.append(
                {
                    "run_folder": f"{FOLDER}/{folder}",
                    "low_x_z": cell.low,
                    "high_x_z": cell.high,
                    "views": int(chosen.sum()),
                    "splats_trained": len(splats),
                    "splats_in_cell": int(own.sum()),
                }
            )
        self.report.metric("blocks", facts)
        return parts

    def _course(self, folders: Sequence[str], folder: Path) -> tuple[int, dict[str, Path]]:
        """(the steps of the longest training of a block; the masks of what moved, which are written
        to `folder`). The coarse model's are of smaller pictures, so they are left out."""
        steps, found = 0, []
        for name in sorted({*folders}):  # one at a time, as in `_parts`
            block = self._trained(name)
            steps = max(steps, block.steps)
            if name != COARSE:
                found.append(block.masks)
        shutil.rmtree(folder / transients.FOLDER, ignore_errors=True)
        masks = transients.join_masks(folder, found)
        if masks:
            self.report.warn(
                "train-transients",
                f"Something moved in {counted(len(masks), 'photograph')}: training ignored the "
                "parts that other photographs do not confirm, see "
                f"{FOLDER}/*/4-train/transients.png.",
            )
        return steps, masks

    def _own(
        self, splats: Splats, cell: Cell, most: int, views: Sequence[View]
    ) -> NDArray[np.bool_]:
        """[N] which of a block's splats go into the merged scene: at most `most` of its cell."""
        own = cell.holds(splats.means)
        if own.sum() <= most:
            return own
        training = [view for view in views if view.role != "test"]
        photographs = load_evaluation_views(self.whole.folder, training, splats.draw_settings)
        return merge.most_visible(splats, own, most, photographs, self.settings.backend)

    def _begin(
        self, name: str, part: Reconstruction, seeds: Splats, coarse: Splats, wide: Cell
    ) -> int:
        """Make a block's run folder. Returns the largest number of its splats, background included.

        The cell gets the fraction of the scene's splats that it has of the coarse model's."""
        inside = int(wide.holds(coarse.means).sum())
        own = max(1, round(self.settings.max_splats * inside / len(coarse)))
        start = merge.initial_splats(seeds, coarse, wide, own)
        cap: int = max(len(start), len(coarse) - inside + own)
        settings = replace(
            self.settings, max_splats=cap, splats_per_view=0, within=(*wide.low, *wide.high)
        )
        block_folders.begin(self.pipeline, self.root / name, part, start, settings)
        return cap

    def _trained(self, name: str) -> TrainedSplats:
        trained: TrainedSplats = Pipeline(self.root / name).load("train")
        return trained

    def _run(self, names: Sequence[str], most_splats: int) -> None:
        """Train in the run folders of these names. Raises SplatError for the first that failed,
        after the others have ended."""
        tasks = [RunTask(self.root / name, until="train") for name in names]
        run_all(
            self.executor,
            tasks,
            resources_of(replace(self.settings, max_splats=most_splats)),
            self.report.stop_requested,
            lambda done: self.report.progress(done, len(names), "blocks"),
            hint="Give the same command again: finished blocks are kept.",
        )

    def _merge(
        self,
        parts: Sequence[Splats],
        cells: Sequence[Cell],
        seam_views: Sequence[View],
        draw_settings: DrawSettings,
        training_views: int,
    ) -> TrainedSplats:
        """The blocks as one model, block after block, whose seams are fine-tuned on `seam_views`.
        training_views: how many the whole scene has."""
        degree, backend = self.settings.sh_degree, self.settings.backend
        splats, counts = merge.merge_blocks(
            [part.with_sh_degree(degree) for part in parts], cells, draw_settings
        )
        dropout = uses_dropout(training_views)
        seam = merge.at_seams(splats, counts, cells)
        removed = np.zeros(len(splats), bool)
        if seam_views:
            self.report.progress(0, 1, "seams")
            photographs = load_evaluation_views(self.whole.folder, seam_views, draw_settings)
            extent = training_extent(self.whole)
            finetuner = FineTuner(photographs, extent, backend, self.report, dropout)
            splats, removed = merge.finetune_seams(splats, seam, photographs, finetuner, backend)
        ends = np.cumsum([0, *counts])
        by_block = [int((~removed[i:j]).sum()) for i, j in pairwise(ends)]
        self.report.metric("splats", len(splats))
        self.report.metric("splats_by_block", by_block)
        self.report.metric("pruned_at_seams", int(removed.sum()))
        return TrainedSplats(splats, dropout)


class _BlockProgress(Listener):
    """Reports the progress of runs in this process as progress of the whole training."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._started = 0

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._started += 1

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        run = "coarse model" if self._started < 2 else f"block {self._started - 1}"
        self._report.progress(done, total, f"{run}: {label}", **numbers)


def _with_roles(whole: Reconstruction) -> Reconstruction:
    """The reconstruction with a role for each view, so that no block trains on another block's
    held-out views."""
    _, held = split_held_out(whole.views)
    names = {view.name for view in held}
    if not names:
        return whole
    views = (replace(v, role="test" if v.name in names else "train") for v in whole.views)
    return replace(whole, views=tuple(views))


def check_settings(settings: TrainSettings) -> None:
    """Raises SplatError for settings that do not go with several blocks."""
    if not settings.max_splats:
        raise UsageError(
            "blocks-without-cap",
            given="--blocks was given, and no maximum of splats.",
            wanted="A maximum that the blocks can share: the free memory limits only one block.",
            hint="Give --max-splats, for example 250000 for each block.",
        )
    unfit = {  # what takes it back: leaving it away keeps what the run has recorded
        "--seconds": ("--seconds 0", settings.seconds),
        "--within": ("--within 0 0 0 0", settings.within),
        "--refine-in-training": ("--no-refine-in-training", settings.refine_in_training),
        "--splats": ('--splats ""', settings.splats),
    }
    if found := {flag: unset for flag, (unset, value) in unfit.items() if value}:
        command = "`splat process`" if settings.splats else "the command"  # seeding has them, too
        raise UsageError(
            "blocks-without-end",
            given=f"--blocks cannot be combined with {' and '.join(found)}.",
            wanted="Steps, which each block makes: --steps.",
            hint=f"Add `{' '.join(found.values())}` to {command}.",
        )
