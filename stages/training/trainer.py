"""The training loop: a view, a picture, a loss, a step; now and then more splats or fewer."""

from __future__ import annotations

import math
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
from stages.measure.images import psnr
from stages.measure.judge import Photograph, scores, spread
from stages.raster.backends import AUTO, backend_of, rasteriser_of
from stages.raster.definition import NO_SMOOTHING, RasterSettings
from stages.raster.smoothing import smoothing_widths
from stages.scene import TRANSPARENT, Camera, Look, Splats, morton
from stages.training.cap import fitted, lower_cap
from stages.training.checkpoint import (
    Maker,
    Saved,
    keep_model,
    kept_model,
    load_checkpoint,
    save_checkpoint,
)
from stages.training.clock import Clock, Spent
from stages.training.colours import Recolouring, worth_settling
from stages.training.density import Within
from stages.training.dropout import Dropout
from stages.training.frugal_step import FrugalStep
from stages.training.optimiser import LearningRates, Model, empty_model, new_model
from stages.training.pace import BY_HEART, Mark, Pace, remaining_gain_db, share_passed_on
from stages.training.schedule import GROWTH_ENDS, Schedule
from stages.training.step import TrainingStep, step_of
from stages.training.strategies import STRATEGIES
from stages.training.target import target_of
from stages.training.trial import BEFORE, DOUBT_DB, PLAIN, SURE_DB, Trial, trial_at
from stages.training.views import Level, TrainingView

CHECKPOINT_SECONDS = 30.0
SMOOTHING_INTERVAL = 100  # steps after which the filters are measured anew
EVALUATIONS = 10  # during a run, evenly spaced
LAST_WORDS = 8.0  # times as long as one of them: the last judgement, with FLIP, and what is written
MARKS = 50  # as often, where patience is asked for, the photographs that were lent are looked at


@dataclass
class Trainer:
    """One run. schedule: as planned so far; a time limit or a plateau changes it. held_out: what
    judges it. look: how they are drawn. cap: splats at most. folder: where checkpoints go. smooth:
    under the 3D smoothing filter. over_any: over another background at each step, as cut-out
    photographs always are. backend: what draws and steps. lent: rows of `train` that decide, and
    are trained on only once it grows no more. patience_db: what going on must promise to give.
    seconds: of wall time in all, 0 for as long as the steps take. within: where it grows, see
    `density.Within`; () for everywhere. growth: by which of STRATEGIES."""

    schedule: Schedule
    train: list[TrainingView]
    held_out: Sequence[Photograph]
    look: Look
    cap: int
    folder: Path
    report: Report
    smooth: bool = False
    over_any: bool = False
    backend: str = AUTO
    lent: tuple[int, ...] = ()
    patience_db: float = 0.0
    seconds: float = 0.0
    within: tuple[float, ...] = ()
    growth: str = "adaptive"

    def __post_init__(self) -> None:
        self.stepper: TrainingStep = step_of(self.backend)
        if self.backend == AUTO:
            self.stepper = FrugalStep(self.stepper, self._memory_full)
        self.makers: list[Maker] = []
        self._strategy = STRATEGIES[self.growth](self.schedule.extent, len(self.train))
        if self.within:
            self._strategy = Within(self._strategy, self.within)
        self.ended = ""  # why before all steps, if it did
        self.marks: list[Mark] = []  # of the photographs lent
        self.trial: Trial | None = None
        # Where none can be lent, so few photographs are learnt by heart.
        self.gain_db: float | None = None if self.lent else math.inf  # by sitting out
        self.over_any |= any(view.levels[0].outside == TRANSPARENT for view in self.train)
        # The course is told by some of very many, so that judging does not outlast training.
        self._onlookers = [self.held_out[i] for i in spread(len(self.held_out))]
        self.history: list[dict[str, Any]] = []
        self.times: list[Spent] = []  # of each entry of the history, kept apart: no two runs agree

    def run(self, start: Splats) -> Model:
        """Train from `start`, or go on from the folder's checkpoint; the finished model.

        Raises Interrupted at a step boundary, checkpoint written, when the report asks to stop.
        """
        self.report.progress(0, 1, "compiling kernels")  # a phase of its own, with its own pace
        self.clock, self._pace = Clock(), Pace(self.seconds)
        step = self._begin(start)
        last_saved = time.monotonic()
        while step < self.schedule.steps:
            loss = self.step(step)
            self._adapt(step)
            step += 1
            if step == self.schedule.steps and worth_settling(self.sits_out, len(self.train)):
                self._recolour()
            if not self.trial:
                if self.schedule.passes(step, EVALUATIONS):
                    self._record(step)
                self._replan(step)
            step = self._tried(step)
            if self.report.stop_requested.is_set() and step < self.schedule.steps:
                self._save(step)
                raise Interrupted(f"train stopped after step {step} of {self.schedule.steps}")
            if time.monotonic() - last_saved > CHECKPOINT_SECONDS:
                self._save(step)
                last_saved = time.monotonic()
            self._tick(step, loss)
            self.report.offer(partial(self.draw, step))
        return self.model

    def _recolour(self) -> None:
        """See `colours`; at full size, in all of its view-dependent colour."""
        model = self.model
        self.stepper.load(empty_model())  # a device may have no room for both
        rasteriser = rasteriser_of(backend_of(self.backend).name)
        settings = self.settings(self.schedule.sh_degree)
        widths = model.smoothing if self.smooth else NO_SMOOTHING
        self.stepper.load(Recolouring(rasteriser, settings, self._full_size, widths).of(model))

    def _full_size(self) -> Iterator[Level]:
        return (view.levels[-1] for view in self.train)

    @property
    def sits_out(self) -> bool:
        """Whether splats sit steps out from where growth ends, as lent photographs told."""
        return self.gain_db is not None and self.gain_db > DOUBT_DB

    @property
    def by_heart(self) -> bool:
        """Whether photographs are learnt by heart, as lent ones told."""
        return self.gain_db is not None and self.gain_db > SURE_DB

    @property
    def model(self) -> Model:
        """As it is now, on the host."""
        return self.stepper.model()

    def _begin(self, start: Splats) -> int:
        """Have the stepper hold the model to go on with; the steps that it has had."""
        saved = load_checkpoint(self.folder)
        if saved is not None:
            model, told = saved
            step, self.history, self.marks = told.step, told.history, told.marks
            self.trial, self.gain_db = told.trial, told.gain_db
            *self.times, spent = told.times
            self.schedule = self.schedule.as_planned(*told.plan)
            self.clock, self.makers = Clock(spent), told.makers
            model = fitted(model, self.cap)
            self.report.metric("resumed_from_step", step)
        else:
            model, step = self._first(start), 0
        self._take_over(step)
        self.stepper.load(model)
        return step

    def _take_over(self, step: int) -> None:
        """Enter who makes the steps from here on, and say so where somebody else began."""
        chosen = backend_of(self.backend)
        maker, before = Maker(step, chosen.name, chosen.where()), self.makers[-1:]
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
        told = self.marks, self.trial, self.gain_db
        saved = Saved(step, plan, self.history, *told, times, self.makers)
        save_checkpoint(self.folder, self.model, saved)

    def _first(self, start: Splats) -> Model:
        start = start.with_sh_degree(self.schedule.sh_degree)
        if len(start) > self.cap:
            start = start.take(np.linspace(0, len(start) - 1, self.cap).round().astype(np.int64))
        start = start.take(morton.order(start))
        return new_model(*(np.array(a, np.float32, order="C") for a in start.arrays))

    def settings(self, degree: int) -> RasterSettings:
        grey = self.look.background
        return RasterSettings(near=self.look.near, sh_degree=degree, background=(grey,) * 3)

    def widths(self, means: NDArray[np.floating]) -> NDArray[np.float32]:
        """[N] of the smoothing filter, from all training photographs at full size."""
        cameras = [view.levels[-1].camera for view in self.train]
        return smoothing_widths(means, cameras, self.look.near)

    def step(self, step: int) -> float:
        """One step of Adam on one photograph; the loss before it."""
        if self.smooth and step % SMOOTHING_INTERVAL == 0:
            self._smooth_anew(self.model)
        view = self.train[self._row(step)]
        level = view.levels[self.schedule.level(step)]
        if step + 1 < self.schedule.steps:
            self.train[self._row(step + 1)].expect(self.schedule.level(step + 1))
        settings = self.settings(self.schedule.active_sh_degree(step))
        if self.over_any:
            settings = replace(settings, background=self.schedule.background(step))
        factor = self.schedule.rate_factor(step)
        rates = LearningRates().scaled(self.schedule.means_lr(step), factor)
        return self.stepper.step(level, settings, rates, self.smooth, self._dropout(step))

    def _dropout(self, step: int) -> Dropout | None:
        """Once the model grows no more: before that, who sits out would be pulled at less than it
        deserves."""
        sits_out = self.trial.sits_out if self.trial else self.sits_out
        if not sits_out or self.schedule.share(step) < GROWTH_ENDS:
            return None
        return Dropout(len(self.train), self.schedule.key(step))

    def _row(self, step: int) -> int:
        """Which photograph is trained on in `step`: none that is lent, while they are asked."""
        lent = self.lent if self.trial or self.schedule.share(step) < GROWTH_ENDS else ()
        rows = [row for row in range(len(self.train)) if row not in lent]
        return rows[self.schedule.view(step, len(rows))]

    def _smooth_anew(self, model: Model) -> None:
        model.smoothing[:] = self.widths(model.means)
        self.stepper.load(model)

    def _replan(self, step: int) -> None:
        """Change the plan after `step` steps, if time or a plateau asks for it."""
        if step == self.schedule.steps:
            return  # its course is run, whatever time is left
        if self.seconds and (steps := self._pace.steps(step, self.clock.spent().seconds)):
            self.schedule = self.schedule.replanned(step, steps)
        if not self.lent or not self.patience_db or not self.schedule.passes(step, MARKS):
            return
        if self.schedule.share(step) > GROWTH_ENDS:
            return
        self.marks.append(Mark(step, self._mean_db(self.lent), self._mean_db(self._told())))
        promised = remaining_gain_db(self.marks, round(GROWTH_ENDS * self.schedule.steps))
        if share_passed_on(self.marks) < BY_HEART and promised < self.patience_db:
            self.schedule = self.schedule.grown(step)
            self.ended = f"after {step} steps growth promised no more than {self.patience_db} dB"

    def _tried(self, step: int) -> int:
        """The step to go on from after `step` steps: where growth ends, two ways are gone from the
        same model, see `trial`."""
        if not self.trial:
            if self.gain_db is None and (trial := trial_at(step, self.schedule)):
                keep_model(self.folder, BEFORE, self.model)
                self.trial = trial
            return step
        if step < self.trial.ends:
            return step
        came_to = self._mean_db(self.lent)
        if self.trial.plain_db is None:
            keep_model(self.folder, PLAIN, self.model)
            self.stepper.load(kept_model(self.folder, BEFORE))
            self.trial = replace(self.trial, plain_db=came_to)
            return self.trial.begun
        self.gain_db = came_to - self.trial.plain_db
        if not self.sits_out:
            self.stepper.load(kept_model(self.folder, PLAIN))
        self.trial = None
        self._pace.restart()
        return step

    def _told(self) -> list[int]:
        """As many photographs as are lent, of those that are not, spread over the capture."""
        others = [row for row in range(len(self.train)) if row not in self.lent]
        return others[:: max(1, len(others) // len(self.lent))]

    def _mean_db(self, rows: Sequence[int]) -> float:
        """Mean PSNR of these photographs, as the model is."""
        values = []
        for row in rows:
            level = self.train[row].levels[-1]
            image = np.clip(self.drawn(level.camera), 0.0, 1.0).transpose(2, 0, 1)
            asked = target_of(level, image, (self.look.background,) * 3)
            values.append(psnr(image, np.asarray(asked, np.float32) / (255 if level.plain else 1)))
        return float(np.mean(values))

    def _adapt(self, step: int) -> None:
        if not self.schedule.densifies_after(step):
            return
        model = self._strategy.prune(self.model, self.schedule.prunes_giants(step))
        budget = min(self.schedule.budget(step, self.cap), self.cap)  # which may have been lowered
        model = self._strategy.grow(model, budget, self.schedule.rng(step))
        model = model.take(morton.order_of(model.means))
        if self.smooth:
            model.smoothing[:] = self.widths(model.means)
        self.stepper.load(model)

    def _tick(self, step: int, loss: float) -> None:
        numbers: dict[str, float | int | str] = {
            "splats": len(self.stepper),
            "loss": round(loss, 4),
        }
        if self.history and "psnr_db" in self.history[-1]:
            numbers["held_out_psnr_db"] = round(self.history[-1]["psnr_db"], 2)
        again = self.trial and self.trial.sits_out
        label = "training again, splats sitting steps out" if again else "training"
        self.report.progress(step, self.schedule.steps, label, **numbers)

    def _record(self, step: int) -> None:
        began = self.clock.spent().seconds
        found = scores(self.drawn, self._onlookers)
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
