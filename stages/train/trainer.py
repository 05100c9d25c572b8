"""A training run: what it is given, its state, and one step.

A step renders one training view, computes the loss and its gradients, and updates the splats.
`loop` makes all steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.evaluate.evaluation import EvaluationView
from stages.raster.backends import AUTO
from stages.raster.definition import RasterSettings
from stages.raster.smoothing import smoothing_widths
from stages.scene import TRANSPARENT, Camera, DrawSettings, Splats
from stages.train.average import ParameterAverage
from stages.train.camera_refinement import STARTS, CameraRefinement
from stages.train.cap import Cap, lower_cap, most_opaque
from stages.train.checkpoint import (
    Provenance,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
)
from stages.train.clock import Clock
from stages.train.conversion import initial_model
from stages.train.dropout import Dropout, uses_dropout
from stages.train.history import History
from stages.train.optimiser import LearningRates, Model
from stages.train.schedule import Schedule
from stages.train.steps.memory_limited import MemoryLimitedStep
from stages.train.steps.step import StepInput, TrainingStep, step_of
from stages.train.transients import without
from stages.train.views import Level, TrainingView

REGISTRATION_STEPS = 60  # for each held-out view
SMOOTHING_INTERVAL = 100  # steps after which the widths of the smoothing filter are computed again


@dataclass(frozen=True)
class TrainingTask:
    """What a training run is given. Nothing in it changes during the run.

    Args:
        views: the training views.
        held_out: the held-out views that the model is evaluated on.
        draw_settings: how the splats are drawn.
        folder: where checkpoints are written.
        report: for progress, metrics and warnings.
        smooth: whether to train under the 3D smoothing filter (Yu et al. 2024, "Mip-Splatting").
        any_background: whether each step has a random background, as it always has where views are
            cut out.
        backend: the rasteriser's, which also decides the training step.
        seconds: limit of wall time; 0 for none.
        most_steps: that a limit of wall time may plan; 0 for any number.
        within: rectangle of the ground plane that densification is limited to, see
            `density.BoundedDensity`; () for none.
    """

    views: Sequence[TrainingView]
    held_out: Sequence[EvaluationView]
    draw_settings: DrawSettings
    folder: Path
    report: Report
    smooth: bool = False
    any_background: bool = False
    backend: str = AUTO
    seconds: float = 0.0
    most_steps: int = 0
    within: tuple[float, ...] = ()

    @property
    def random_background(self) -> bool:
        """Whether each step has a background of its own."""
        cut_out = any(view.levels[0].outside == TRANSPARENT for view in self.views)
        return self.any_background or cut_out

    @property
    def dropout(self) -> bool:
        """Whether splats are dropped from steps once densification has ended."""
        return uses_dropout(len(self.views))


@dataclass
class Trainer:
    """The state of a training run.

    Args:
        task: what the run is given.
        schedule: what happens at which step; a time limit replaces it.
        cap: the largest number of splats; a full device lowers it.
        refinement: of the cameras of the training views; None leaves them as they are.
        transient: for each training view [h, w] the parts that show what moved; empty before
            this is known.
    """

    task: TrainingTask
    schedule: Schedule
    cap: Cap
    refinement: CameraRefinement | None = None
    stepper: TrainingStep = field(init=False)
    clock: Clock = field(init=False, default_factory=Clock)
    loss: float = field(init=False, default=float("nan"))  # of the last step
    history: History = field(init=False, default_factory=History)
    provenance: list[Provenance] = field(init=False, default_factory=list)
    transient: list[NDArray[np.bool_]] = field(init=False, default_factory=list)
    average: ParameterAverage = field(init=False, default_factory=ParameterAverage)
    _random_background: bool = field(init=False)

    def __post_init__(self) -> None:
        self.stepper = step_of(self.task.backend)
        if self.task.backend == AUTO:
            self.stepper = MemoryLimitedStep(self.stepper, self._lower_cap)
        self._random_background = self.task.random_background

    def begin(self, start: Splats) -> int:
        """Load the checkpoint's model, or else one of `start`; how many steps it has had."""
        report = self.task.report
        self.clock = Clock()
        saved, step = load_checkpoint(self.task.folder, report.warn), 0
        if saved is None:
            model = initial_model(start, self.schedule.sh_degree, self.cap.splats)
            self._place(model)
        else:
            model, state = most_opaque(saved[0], self.cap.splats), saved[1]
            step, self.provenance, self.transient = state.step, state.provenance, state.transient
            self.average = state.average
            *times, elapsed = state.times
            self.history, self.clock = History(state.history, times), Clock(elapsed)
            self.schedule = self.schedule.as_planned(*state.plan)
            if self.refinement is not None and state.refinement is not None:
                self.refinement.load(state.refinement)
            report.metric("resumed_from_step", step)
        now = Provenance.of_backend(step, self.task.backend)
        if changed := now.change_since(self.provenance):
            report.progress(step, self.schedule.steps, changed)
        if changed or not self.provenance:
            self.provenance.append(now)
        self.stepper.load(model)
        return step

    def step(self, step: int) -> float:
        """Make step number `step` (from 0) on one training view; the loss before it."""
        smooth, schedule = self.task.smooth, self.schedule
        if smooth and step % SMOOTHING_INTERVAL == 0:
            self.replace_model(self.model)
        row, refine = self._row(step), None
        level = self.level(row, schedule.level(step))
        if self.refinement is not None:
            refine = partial(self.refinement.update, row, schedule.share(step))
        if step + 1 < schedule.steps:
            self.task.views[self._row(step + 1)].prefetch(schedule.level(step + 1))
        settings = self.raster_settings(schedule.active_sh_degree(step))
        if self._random_background:
            settings = replace(settings, background=schedule.background(step))
        rates = schedule.rates(step)
        dropout = None
        if self.task.dropout and not schedule.densifying(step):  # it distorts mean gradients
            dropout = Dropout(len(self.task.views), schedule.dropout_key(step))
        weight, moves = schedule.weight(step), schedule.gauss_newton(step, len(self.task.views))
        given = StepInput(level, settings, rates, smooth, dropout, refine, weight, moves)
        return self.stepper.step(given)

    def registered_held_out(self) -> list[EvaluationView]:
        """The held-out views with cameras refined on their own photographs, with the splats as they
        are. Otherwise they would be compared from where the training views are no longer. Raises
        Interrupted if the report asks to stop."""
        assert self.refinement is not None
        report, held_out = self.task.report, self.task.held_out
        registered: list[EvaluationView] = []
        settings = self.raster_settings(self.schedule.sh_degree)
        for row, view in enumerate(held_out, len(self.task.views)):
            report.progress(len(registered), len(held_out), "registering")
            if report.stop_requested.is_set():
                raise Interrupted("stopped while registering held-out views")
            level = Level.from_pixels(view.camera, view.pixels, view.mask, view.outside)
            for number in range(REGISTRATION_STEPS):
                share = max(STARTS, number / REGISTRATION_STEPS)
                seen = replace(level, camera=self.refinement.camera(row, view.camera))
                refine = partial(self.refinement.update, row, share, with_lens=False)
                rates, smooth = LearningRates().scaled(0.0, 0.0), self.task.smooth
                self.stepper.step(StepInput(seen, settings, rates, smooth, use_gradients=refine))
            registered.append(replace(view, camera=self.refinement.camera(row, view.camera)))
        return registered

    def _row(self, step: int) -> int:
        """Which training view `step` uses."""
        return self.schedule.view(step, len(self.task.views))

    def level(self, row: int, number: int = -1) -> Level:
        """A level of a training view, by default at full size, with its refined camera and without
        what moved."""
        level = self.task.views[row].levels[number]
        if self.refinement is not None:
            level = replace(level, camera=self.refinement.camera(row, level.camera))
        return without(level, self.transient[row]) if self.transient else level

    @property
    def model(self) -> Model:
        """The current model, on the host; good until the next step."""
        return self.stepper.model()

    def replace_model(self, model: Model) -> None:
        """Go on with `model`: at its distances from the cameras, and under new widths of the
        smoothing filter if it is used."""
        self._place(model)
        if self.task.smooth:
            near = self.task.draw_settings.near
            model.smoothing = model.smoothing_widths(self.cameras, near)
        self.stepper.load(model)

    def _place(self, model: Model) -> None:
        """Tell the model its distances from the cameras."""
        model.distances = model.camera_distances(self.cameras, self.schedule.extent)

    def replan(self, step: int, steps: int) -> None:
        """Make `steps` steps in all; `step` are done."""
        self.schedule = self.schedule.replanned(step, steps)

    def smoothing_widths(self, means: NDArray[np.floating]) -> NDArray[np.float32]:
        """[N] of the smoothing filter at positions [N, 3], from all training views at full size."""
        return smoothing_widths(means, self.cameras, self.task.draw_settings.near)

    @property
    def cameras(self) -> list[Camera]:
        """Of the training views, at full size."""
        cameras = [view.levels[-1].camera for view in self.task.views]
        if self.refinement is None:
            return cameras
        return [self.refinement.camera(row, camera) for row, camera in enumerate(cameras)]

    def raster_settings(self, sh_degree: int) -> RasterSettings:
        """To render the model with SH coefficients up to `sh_degree`."""
        drawn = self.task.draw_settings
        background = (drawn.background,) * 3
        return RasterSettings(
            drawn.near, antialias=drawn.antialias, background=background, sh_degree=sh_degree
        )

    def render(self, camera: Camera, sh_degree: int | None = None) -> NDArray[np.float32]:
        """[H, W, 3] of the current model, with all its SH coefficients or up to `sh_degree`."""
        degree = self.schedule.sh_degree if sh_degree is None else sh_degree
        return self.stepper.draw(camera, self.raster_settings(degree), self.task.smooth)

    def save(self, step: int) -> None:
        """Write a checkpoint after `step` steps."""
        state = TrainingState(
            step=step,
            plan=(self.schedule.steps, *self.schedule.since),
            history=self.history.entries,
            times=[*self.history.times, self.clock.elapsed()],
            provenance=self.provenance,
            refinement=None if self.refinement is None else self.refinement.state(),
            transient=self.transient,
            average=self.average,
        )
        save_checkpoint(self.task.folder, self.model.on_host(), state)

    def _lower_cap(self, fits: int) -> None:
        self.cap = lower_cap(self.task.folder, fits)
        self.task.report.progress(0, 1, f"the GPU's memory is full: going on with {fits:,} splats")
