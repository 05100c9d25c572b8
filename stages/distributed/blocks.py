"""One scene in blocks: training as many runs, on whatever brings runs to their end.

A coarse model of the whole is trained first. It says which photographs show which block, and
stands for the surroundings while each block is trained, in a run folder of its own under `blocks/`.
Then each block gives what lies in its cell, and seams are put right on the photographs that cross
them.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.errors import Family, SplatError
from stages.base.stage import Numbers, Report, Stage
from stages.base.text import counted
from stages.distributed import block_folders
from stages.distributed.tasks import Executor, OpenExecutor, RunTask, resources_of, run_all
from stages.raster.backends import backend_of_settings
from stages.run.pipeline import Listener, Pipeline

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stages.distributed.partition import Cell
    from stages.scene import DrawSettings, Reconstruction, Splats, TrainedSplats, View

FOLDER, COARSE = "blocks", "coarse"
PHOTOGRAPHS_A_BLOCK = 250
# As much less than is asked of the whole; and no more splats than one of the blocks gets.
COARSE_STEPS, COARSE_SIDE, COARSE_SPLATS = 3, 2, 4


def in_blocks(pipeline: Pipeline, open_engine: OpenExecutor) -> Pipeline:
    """The pipeline, training in blocks where its settings ask for it."""
    plain = pipeline.layout.stage("train")
    return pipeline.with_run("train", partial(_train, pipeline, plain, open_engine))


def blocks_wanted(asked: str, photographs: int) -> int:
    """How many blocks `TrainSettings.blocks` means for as many photographs."""
    return max(1, round(photographs / PHOTOGRAPHS_A_BLOCK)) if asked == "auto" else int(asked)


def _train(
    pipeline: Pipeline,
    plain: Stage,
    open_engine: OpenExecutor,
    inputs: Mapping[str, Any],
    settings: Any,
    folder: Path,
    report: Report,
) -> Any:
    """The stage `train`, for any number of blocks."""
    single = replace(settings, blocks="1")
    photographs = 0 if settings == single else len(inputs["sfm"].views)
    blocks = blocks_wanted(settings.blocks, photographs)
    if blocks == 1:
        return plain.run(inputs, single, folder, report)
    _check(settings)
    root = pipeline.run_folder.absolute() / FOLDER
    root.mkdir(exist_ok=True)
    with open_engine(root, _Told(report)) as engine:
        scene = _Scene(pipeline, _with_roles(inputs["sfm"]), single, root, engine, report)
        return scene.train(blocks, inputs["seed"], folder)


@dataclass
class _Scene:
    """What is trained in blocks. whole: with the judges told apart once for all blocks. settings:
    of the whole. root: the folder of the blocks' run folders."""

    pipeline: Pipeline
    whole: Reconstruction
    settings: Any
    root: Path
    engine: Executor
    report: Report

    def train(self, blocks: int, seeds: Splats, folder: Path) -> TrainedSplats:
        """The merged splats, written to `folder` as training writes them."""
        from stages.distributed import block_views, partition
        from stages.scene import draw_settings_of, split_held_out
        from stages.train import save
        from stages.training.build import corrects_light

        started = time.monotonic()
        light = corrects_light(self.whole, self.settings.light, self.report)
        self.settings = replace(self.settings, light="on" if light else "off")
        coarse = self._coarse(seeds, max(blocks, COARSE_SPLATS))
        training, held = split_held_out(self.whole.views)
        places, weights = partition.weighted_points(replace(self.whole, views=training))
        cells = partition.partition(places, weights, blocks)
        cameras = [view.camera for view in self.whole.views]
        member = block_views.assign_views(
            block_views.block_fractions(coarse, cells, cameras, backend_of_settings(self.settings))
        )
        folders = self._blocks(seeds, coarse, cells, member, partition.margin(places))
        parts = self._parts(folders, cells, member)
        draw_settings = draw_settings_of(self.whole.views, self.settings.train_side, light)
        crossed = block_views.crosses_blocks(member)
        crossing = [v for v, both in zip(self.whole.views, crossed, strict=True) if both]
        teachers = [view for view in crossing if view in training]
        trained = self._joined(parts, cells, teachers, draw_settings)
        save(folder, trained)
        self._evaluate(trained.splats, held, folder)
        self.report.metric("training_views", len(training))
        self.report.metric("held_out_views", len(held))
        self.report.metric("crossing", [view.name for view in crossing])
        self.report.metric("train_seconds", round(time.monotonic() - started, 1))
        return trained

    def _evaluate(self, splats: Splats, held: Sequence[View], folder: Path) -> None:
        from stages.measure.evaluation import image_renderer, load_evaluation_views
        from stages.training.quality import write_history, write_quality

        settings = splats.draw_settings
        views = load_evaluation_views(self.whole.folder, held, settings)
        render = image_renderer(splats, backend_of_settings(self.settings))
        write_quality(render, views, settings, self.whole, folder, self.report)
        write_history([], [], folder, self.report)

    def _coarse(self, seeds: Splats, fewer: int) -> Splats:
        settings = replace(
            self.settings,
            steps=max(1, self.settings.steps // COARSE_STEPS),
            train_side=max(16, self.settings.train_side // COARSE_SIDE),
            max_splats=max(1, self.settings.max_splats // fewer),
        )
        block_folders.begin(self.pipeline, self.root / COARSE, self.whole, seeds, settings)
        self._run([COARSE], settings.max_splats)
        return self._trained(COARSE).splats

    def _blocks(
        self,
        seeds: Splats,
        coarse: Splats,
        cells: Sequence[Cell],
        member: NDArray[np.bool_],
        margin: float,
    ) -> list[str]:
        """Train each block; by cell, the run folder that has it: the coarse model's for a cell that
        no photograph shows."""
        folders, largest = [], 0
        for number, (cell, chosen) in enumerate(zip(cells, member, strict=True), start=1):
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
        for left in self.root.iterdir():  # by an earlier cut into more blocks
            if left.name.isdigit() and left.name not in folders:
                shutil.rmtree(left)
        self._run([folder for folder in folders if folder != COARSE], largest)
        return folders

    def _parts(
        self, folders: Sequence[str], cells: Sequence[Cell], member: NDArray[np.bool_]
    ) -> list[TrainedSplats]:
        """What each block learnt of its cell, together no more splats than the whole may have. One
        block at a time is held whole."""
        parts: list[TrainedSplats] = []
        told = []
        given = [
            int(cell.holds(self._trained(folder).splats.means).sum())
            for folder, cell in zip(folders, cells, strict=True)
        ]
        share = min(1.0, self.settings.max_splats / max(1, sum(given)))
        for number, (folder, cell, chosen) in enumerate(zip(folders, cells, member, strict=True)):
            trained = self._trained(folder)
            views = tuple(v for v, shows in zip(self.whole.views, chosen, strict=True) if shows)
            own = self._own(trained.splats, cell, int(share * given[number]), views)
            parts.append(replace(trained, splats=trained.splats.take(own)))
            told.append(
                {
                    "run_folder": f"{FOLDER}/{folder}",
                    "low_x_z": cell.low,
                    "high_x_z": cell.high,
                    "photographs": int(chosen.sum()),
                    "splats_trained": len(trained.splats),
                    "splats_given": int(own.sum()),
                }
            )
        self.report.metric("blocks", told)
        return parts

    def _own(
        self, splats: Splats, cell: Cell, most: int, views: Sequence[View]
    ) -> NDArray[np.bool_]:
        """[N] which of a block's splats are of the whole: those of its cell, at most as many."""
        from stages.distributed import merge
        from stages.measure.evaluation import load_evaluation_views

        own = cell.holds(splats.means)
        if own.sum() <= most:
            return own
        training = [view for view in views if view.role != "test"]
        photographs = load_evaluation_views(self.whole.folder, training, splats.draw_settings)
        return merge.shown_most(splats, own, most, photographs, backend_of_settings(self.settings))

    def _begin(
        self, name: str, part: Reconstruction, seeds: Splats, coarse: Splats, wide: Cell
    ) -> int:
        """Make a block's run folder; how many splats it may have, its surroundings included. Of
        the whole's, it has the share that the coarse model has in its cell."""
        from stages.distributed import merge

        inside = int(wide.holds(coarse.means).sum())
        own = max(1, round(self.settings.max_splats * inside / len(coarse)))
        start = merge.surrounded(seeds, coarse, wide, own)
        cap: int = max(len(start), len(coarse) - inside + own)
        settings = replace(self.settings, max_splats=cap, within=(*wide.low, *wide.high))
        block_folders.begin(self.pipeline, self.root / name, part, start, settings)
        return cap

    def _trained(self, name: str) -> TrainedSplats:
        found: TrainedSplats = Pipeline(self.root / name).load("train")
        return found

    def _run(self, names: Sequence[str], most_splats: int) -> None:
        """Train in the run folders of these names. Raises SplatError for the first that failed,
        once the others have ended."""
        tasks = [RunTask(self.root / name, until="train") for name in names]
        run_all(
            self.engine,
            tasks,
            resources_of(replace(self.settings, max_splats=most_splats)),
            self.report.stop_requested,
            lambda done: self.report.progress(done, len(names), "blocks"),
            hint="Give the same command again: blocks that are finished are kept.",
        )

    def _joined(
        self,
        parts: Sequence[TrainedSplats],
        cells: Sequence[Cell],
        crossing: Sequence[View],
        draw_settings: DrawSettings,
    ) -> TrainedSplats:
        """The blocks as one, their seams put right by the photographs that cross them. In the
        report, how many splats each gave: they lie block after block."""
        import numpy as np

        from stages.distributed import merge
        from stages.measure.evaluation import load_evaluation_views
        from stages.scene import TrainedSplats, training_extent
        from stages.training.finetune import FineTuner

        degree, backend = self.settings.sh_degree, backend_of_settings(self.settings)
        given = [part.splats.with_sh_degree(degree) for part in parts]
        splats, counts = merge.merged(given, cells, draw_settings)
        dropout = np.mean([part.dropout for part in parts]) > 0.5
        overfitted = np.mean([part.overfitted for part in parts]) > 0.5
        found = TrainedSplats(splats, bool(dropout), bool(overfitted))
        seam = merge.at_seams(splats, counts, cells)
        gone = np.zeros(len(splats), bool)
        if crossing:
            self.report.progress(0, 1, "seams")
            photographs = load_evaluation_views(self.whole.folder, crossing, draw_settings)
            extent = training_extent(self.whole)
            tuner = FineTuner(photographs, extent, backend, self.report, found.dropout)
            splats, gone = merge.put_right(splats, seam, photographs, tuner, backend)
        ends = np.cumsum([0, *counts])
        left = [int((~gone[i:j]).sum()) for i, j in pairwise(ends)]
        self.report.metric("splats", len(splats))
        self.report.metric("splats_by_block", left)
        self.report.metric("splats_at_seams", int(seam.sum()))
        self.report.metric("pruned_at_seams", int(gone.sum()))
        return replace(found, splats=splats)


class _Told(Listener):
    """What runs in this process say, told as progress of the whole."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._started = 0

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._started += 1

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        which = "coarse model" if self._started < 2 else f"block {self._started - 1}"
        self._report.progress(done, total, f"{which}: {label}", **numbers)


def _with_roles(whole: Reconstruction) -> Reconstruction:
    """With the judges of the whole named, so that no block learns from another one's."""
    from stages.scene import split_held_out

    _, held = split_held_out(whole.views)
    judges = {view.name for view in held}
    if not judges:
        return whole
    views = (replace(v, role="test" if v.name in judges else "train") for v in whole.views)
    return replace(whole, views=tuple(views))


def _check(settings: Any) -> None:
    """Raises SplatError for what cannot be asked of blocks."""
    if not settings.max_splats:
        raise SplatError(
            "blocks-without-cap",
            given="--blocks was asked for, and nothing says how many splats the whole may have.",
            wanted="A number of splats that blocks can share: what is free in memory tells only of "
            "one of them.",
            hint="Give --max-splats, for example 250000 for each block.",
            family=Family.USAGE,
        )
    if settings.seconds or settings.within:
        raise SplatError(
            "blocks-without-end",
            given="--blocks cannot be had together with --seconds or --within.",
            wanted="Steps, which each block makes: --steps.",
            hint="Leave --seconds and --within away.",
            family=Family.USAGE,
        )
