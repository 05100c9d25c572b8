"""The training loop: a view, a picture, a loss, a step; now and then more splats or fewer."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.measure.evaluation import EvaluationView, evaluate, evaluation_subset
from stages.measure.image_metrics import psnr
from stages.raster.backends import AUTO, backend_of, rasteriser_of
from stages.raster.definition import NO_SMOOTHING, RasterSettings
from stages.raster.smoothing import smoothing_widths
from stages.scene import TRANSPARENT, Camera, DrawSettings, Splats, morton
from stages.training.cap import lower_cap, most_opaque
from stages.training.checkpoint import (
    Provenance,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
)
from stages.training.clock import Clock, Elapsed
from stages.training.colour_refit import ColourRefit, needs_colour_refit
from stages.training.density import AdaptiveDensity, BoundedDensity
from stages.training.dropout import Dropout
from stages.training.free_space import known_free_space
from stages.training.memory_limited_step import MemoryLimitedStep
from stages.training.optimiser import LearningRates, Model, empty_model, new_model
from stages.training.schedule import Schedule
from stages.training.step import TrainingStep
from stages.training.steps import step_of
from stages.training.target import target_of
from stages.training.time_limit import TimeLimit
from stages.training.validation import EVALUATIONS, EarlyStopping, uses_dropout
from stages.training.views import Level, TrainingView

CHECKPOINT_SECONDS = 30.0
SMOOTHING_INTERVAL = 100  # steps after which the filters are measured anew
FLOATER_REMOVALS = 20  # likewise: how often floaters are removed
LAST_WORDS = 8.0  # times as long as one of them: the last judgement, with FLIP, and what is written


@dataclass
class Trainer:
    """One run. schedule: as planned so far; a time limit or a plateau changes it. held_out: what
    judges it. look: how they are drawn. cap: splats at most. folder: where checkpoints go. smooth:
    under the 3D smoothing filter. over_any: over another background at each step, as cut-out
    photographs always are. backend: what draws and steps. validation: rows of `train` that are
    trained on only after densification. patience_db: see `validation.EarlyStopping`.
    seconds: of wall time in all, 0 for as long as the steps take. within: where it grows, see
    `density.BoundedDensity`; () for everywhere."""

    schedule: Schedule
    train: list[TrainingView]
    held_out: Sequence[EvaluationView]
    draw_settings: DrawSettings
    cap: int
    folder: Path
    report: Report
    smooth: bool = False
    over_any: bool = False
    backend: str = AUTO
    validation: tuple[int, ...] = ()
    patience_db: float = 0.0
    seconds: float = 0.0
    within: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        self.stepper: TrainingStep = step_of(self.backend)
        if self.backend == AUTO:
            self.stepper = MemoryLimitedStep(self.stepper, self._memory_full)
        self.makers: list[Provenance] = []
        density = AdaptiveDensity(self.schedule.extent, len(self.train))
        self._strategy = BoundedDensity(density, self.within) if self.within else density
        self.early_stopping = EarlyStopping(self.patience_db, self.validation)
        self.over_any |= any(view.levels[0].outside == TRANSPARENT for view in self.train)
        # The course is told by some of very many, so that judging does not outlast training.
        self._onlookers = [self.held_out[i] for i in evaluation_subset(len(self.held_out))]
        self.history: list[dict[str, Any]] = []
        self.times: list[
            Elapsed
        ] = []  # of each entry of the history, kept apart: no two runs agree

    def run(self, start: Splats) -> Model:
        """Train from `start`, or go on from the folder's checkpoint; the finished model.

        Raises Interrupted at a step boundary, checkpoint written, when the report asks to stop.
        """
        self.report.progress(0, 1, "compiling kernels")  # a phase of its own, with its own pace
        self.clock, self._pace = Clock(), TimeLimit(self.seconds)
        step = self._begin(start)
        self._free_space = known_free_space(start.means, self._full_cameras)
        last_saved = time.monotonic()
        while step < self.schedule.steps:
            loss = self.step(step)
            self._adapt(step)
            step += 1
            if step == self.schedule.steps and needs_colour_refit(self.dropout, len(self.train)):
                self._refit_colours()
            if self.schedule.passes(step, EVALUATIONS):
                self._record(step)
            self._replan(step)
            self.schedule = self.early_stopping.next_schedule(self.schedule, step, self._db)
            if self.report.stop_requested.is_set() and step < self.schedule.steps:
                self._save(step)
                raise Interrupted(f"train stopped after step {step} of {self.schedule.steps}")
            if time.monotonic() - last_saved > CHECKPOINT_SECONDS:
                self._save(step)
                last_saved = time.monotonic()
            self._tick(step, loss)
            self.report.offer(partial(self.draw, step))
        return self.model

    def _refit_colours(self) -> None:
        """See `colours`; at full size, in all of its view-dependent colour."""
        model = self.model
        self.stepper.load(empty_model())  # a device may have no room for both
        rasteriser = rasteriser_of(backend_of(self.backend).name)
        settings = self.settings(self.schedule.sh_degree)
        widths = model.smoothing if self.smooth else NO_SMOOTHING
        self.stepper.load(ColourRefit(rasteriser, settings, self._full_size, widths).of(model))

    def _full_size(self) -> Iterator[Level]:
        return (view.levels[-1] for view in self.train)

    @property
    def dropout(self) -> bool:
        """Whether splats are dropped from steps once densification has ended."""
        return uses_dropout(len(self.train))

    @property
    def model(self) -> Model:
        """As it is now, on the host."""
        return self.stepper.model()

    def _begin(self, start: Splats) -> int:
        """Have the stepper hold the model to go on with; the steps that it has had."""
        saved = load_checkpoint(self.folder)
        if saved is not None:
            model, told = saved
            step, self.history = told.step, told.history
            self.early_stopping.best_db = told.validation_best_db
            self.early_stopping.stopped_at = told.densification_stopped_at
            *self.times, spent = told.times
            self.schedule = self.schedule.as_planned(*told.plan)
            self.clock, self.makers = Clock(spent), told.makers
            model = most_opaque(model, self.cap)
            self.report.metric("resumed_from_step", step)
        else:
            model, step = self._first(start), 0
        self._take_over(step)
        self.stepper.load(model)
        return step

    def _take_over(self, step: int) -> None:
        """Enter who makes the steps from here on, and say so where somebody else began."""
        chosen = backend_of(self.backend)
        maker, before = Provenance(step, chosen.name, chosen.describe()), self.makers[-1:]
        if any(replace(maker, step=one.step) == one for one in before):
            return
        self.makers.append(maker)
        for one in before:
            label = f"going on with {maker.backend} on what {one.backend} began"
            self.report.progress(step, self.schedule.steps, label)

    def _memory_full(self, fits: int) -> None:
        self.cap = lower_cap(self.folder, fits).splats
        self.report.progress(0, 1, f"the GPU's memory is full: going on with {fits:,} splats")

    def _save(self, step: int) -> None:
        plan = (self.schedule.steps, *self.schedule.since)
        times = [*self.times, self.clock.spent()]
        told = self.early_stopping.best_db, self.early_stopping.stopped_at
        saved = TrainingState(step, plan, self.history, *told, times, self.makers)
        save_checkpoint(self.folder, self.model, saved)

    def _first(self, start: Splats) -> Model:
        start = start.with_sh_degree(self.schedule.sh_degree)
        if len(start) > self.cap:
            start = start.take(np.linspace(0, len(start) - 1, self.cap).round().astype(np.int64))
        start = start.take(morton.morton_order(start))
        return new_model(*(np.array(a, np.float32, order="C") for a in start.arrays))

    def settings(self, degree: int) -> RasterSettings:
        grey = self.draw_settings.background
        return RasterSettings(
            near=self.draw_settings.near, sh_degree=degree, background=(grey,) * 3
        )

    def widths(self, means: NDArray[np.floating]) -> NDArray[np.float32]:
        """[N] of the smoothing filter, from all training photographs at full size."""
        return smoothing_widths(means, self._full_cameras, self.draw_settings.near)

    @property
    def _full_cameras(self) -> list[Camera]:
        return [view.levels[-1].camera for view in self.train]

    def step(self, step: int) -> float:
        """One step of Adam on one photograph; the loss before it."""
        if self.smooth and step % SMOOTHING_INTERVAL == 0:
            self._smooth_anew(self.model)
        course = self.schedule
        view = self.train[self._row(step)]
        level = view.levels[course.level(step)]
        if step + 1 < course.steps:
            self.train[self._row(step + 1)].expect(course.level(step + 1))
        settings = self.settings(course.active_sh_degree(step))
        if self.over_any:
            settings = replace(settings, background=course.background(step))
        rates = LearningRates().scaled(course.means_lr(step), course.rate_factor(step))
        return self.stepper.step(level, settings, rates, self.smooth, self._dropout(step))

    def _dropout(self, step: int) -> Dropout | None:
        """Once the model grows no more: before that, who sits out would be pulled at less than it
        deserves."""
        if not self.dropout or self.schedule.densifying(step):
            return None
        return Dropout(len(self.train), self.schedule.key(step))

    def _row(self, step: int) -> int:
        """Which photograph is trained on in `step`: none that is lent, while it is densified."""
        lent = self.validation if self.schedule.densifying(step) else ()
        rows = [row for row in range(len(self.train)) if row not in lent]
        return rows[self.schedule.view(step, len(rows))]

    def _smooth_anew(self, model: Model) -> None:
        model.smoothing[:] = self.widths(model.means)
        self.stepper.load(model)

    def _replan(self, step: int) -> None:
        """Change the plan after `step` steps, if there is a time to keep to."""
        if not self.seconds or step == self.schedule.steps:
            return  # once its course is run, whatever time is left
        if steps := self._pace.steps(step, self.clock.spent().seconds):
            self.schedule = self.schedule.replanned(step, steps)

    def _db(self, row: int) -> float:
        """PSNR of a photograph, as the model is."""
        level = self.train[row].levels[-1]
        image = np.clip(self.drawn(level.camera), 0.0, 1.0).transpose(2, 0, 1)
        asked = target_of(level, image, (self.draw_settings.background,) * 3)
        return psnr(image, np.asarray(asked, np.float32) / (255 if level.plain else 1))

    def _adapt(self, step: int) -> None:
        clears = self.schedule.passes(step + 1, FLOATER_REMOVALS)
        grows = self.schedule.densifies_after(step)
        if not (clears or grows):
            return
        model = self.model
        if clears:
            model = model.take(~self._free_space.holds(model.means))
        if grows:
            model = self._grown(model, step)
        if self.smooth:
            model.smoothing[:] = self.widths(model.means)
        self.stepper.load(model)

    def _grown(self, model: Model, step: int) -> Model:
        model = self._strategy.prune(model, self.schedule.prunes_giants(step))
        budget = min(self.schedule.budget(step, self.cap), self.cap)  # which may have been lowered
        model = self._strategy.grow(model, budget, self.schedule.rng(step))
        return model.take(morton.morton_order_of(model.means))

    def _tick(self, step: int, loss: float) -> None:
        numbers: dict[str, float | int | str] = {
            "splats": len(self.stepper),
            "loss": round(loss, 4),
        }
        if self.history and "psnr_db" in self.history[-1]:
            numbers["held_out_psnr_db"] = round(self.history[-1]["psnr_db"], 2)
        self.report.progress(step, self.schedule.steps, "training", **numbers)

    def _record(self, step: int) -> None:
        began = self.clock.spent().seconds
        found = evaluate(self.drawn, self._onlookers)
        entry: dict[str, Any] = {"step": step, "splats": len(self.model)}
        self._pace.reserve = LAST_WORDS * (self.clock.spent().seconds - began)
        if found:
            entry["psnr_db"] = float(np.mean([score.psnr_db for score in found]))
            entry["ssim"] = float(np.mean([score.ssim for score in found]))
        self.history.append(entry)
        self.times.append(self.clock.spent())

    def drawn(self, camera: Camera) -> NDArray[np.float32]:
        """[H, W, 3] of the model as it is, with all of its view-dependent colour."""
        return self.stepper.draw(camera, self.settings(self.schedule.sh_degree), self.smooth)

    def draw(self, step: int, camera: Camera) -> NDArray[np.uint8]:
        """[H, W, 3] of the model after `step` steps, in the colours that training sees by then."""
        settings = self.settings(self.schedule.active_sh_degree(step - 1))
        image = np.clip(self.stepper.draw(camera, settings, self.smooth), 0.0, 1.0)
        return np.rint(image * 255).astype(np.uint8)
