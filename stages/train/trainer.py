"""The training loop of 3D Gaussian splatting (Kerbl et al. 2023).

Each step renders one training view, computes the loss and its gradients, and updates the splats
with Adam. Everything that happens between steps is a `hooks.StepHook`: removal of floaters,
densification, sparsification, the colour refit, evaluation, the time limit, checkpoints, progress
and the live preview.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.evaluate.evaluation import EvaluationView
from stages.raster.backends import AUTO
from stages.raster.definition import RasterSettings
from stages.raster.smoothing import smoothing_widths
from stages.scene import TRANSPARENT, Camera, DrawSettings, Splats
from stages.train.camera_refinement import STARTS, CameraRefinement
from stages.train.cap import lower_cap, most_opaque
from stages.train.checkpoint import (
    Provenance,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
)
from stages.train.clock import Clock, Elapsed
from stages.train.conversion import initial_model
from stages.train.dropout import Dropout, uses_dropout
from stages.train.hooks import step_hooks
from stages.train.optimiser import LearningRates, Model
from stages.train.schedule import Schedule
from stages.train.steps.memory_limited import MemoryLimitedStep
from stages.train.steps.step import StepInput, TrainingStep, step_of
from stages.train.views import Level, TrainingView

REGISTRATION_STEPS = 60  # for each held-out view
SMOOTHING_INTERVAL = 100  # steps after which the widths of the smoothing filter are computed again


@dataclass
class Trainer:
    """One training run.

    Args:
        schedule: what happens at which step; a time limit replaces it.
        train: the training views.
        held_out: the held-out views that the model is evaluated on.
        draw_settings: how the splats are drawn.
        cap: largest number of splats.
        folder: where checkpoints are written.
        report: for progress, metrics and warnings.
        smooth: whether to train under the 3D smoothing filter (Yu et al. 2024, "Mip-Splatting").
        random_background: whether each step has a background of its own, as it always has where
            views are cut out.
        backend: the rasteriser's, which also decides the training step.
        seconds: limit of wall time; 0 for none.
        most_steps: that a limit of wall time may plan; 0 for any number.
        refinement: of the cameras of the training views; None leaves them as they are.
        within: rectangle of the ground plane that densification is limited to, see
            `density.BoundedDensity`; () for none.
    """

    schedule: Schedule
    train: list[TrainingView]
    held_out: Sequence[EvaluationView]
    draw_settings: DrawSettings
    cap: int
    folder: Path
    report: Report
    smooth: bool = False
    random_background: bool = False
    backend: str = AUTO
    seconds: float = 0.0
    most_steps: int = 0
    refinement: CameraRefinement | None = None
    within: tuple[float, ...] = ()
    stepper: TrainingStep = field(init=False)
    clock: Clock = field(init=False, default_factory=Clock)
    loss: float = field(init=False, default=float("nan"))  # of the last step
    history: list[dict[str, Any]] = field(init=False, default_factory=list)  # of evaluations
    times: list[Elapsed] = field(init=False, default_factory=list)  # of each entry of the history
    provenance: list[Provenance] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.stepper = step_of(self.backend)
        if self.backend == AUTO:
            self.stepper = MemoryLimitedStep(self.stepper, self._lower_cap)
        self.random_background |= any(v.levels[0].outside == TRANSPARENT for v in self.train)

    def run(self, start: Splats) -> Model:
        """Train from `start`, or from the checkpoint in the folder, and return the final model.

        Raises Interrupted after a step, with a checkpoint written, if the report asks to stop.
        """
        self.report.progress(0, 1, "compiling kernels")  # a phase of its own, with its own pace
        self.clock = Clock()
        step = self._resume(start)
        hooks = step_hooks(self, start)
        while step < self.schedule.steps:
            self.loss = self.step(step)
            step += 1
            for hook in hooks:
                hook.after_step(self, step)
        return self.model

    def step(self, step: int) -> float:
        """Make step number `step` (from 0) on one training view; the loss before it."""
        if self.smooth and step % SMOOTHING_INTERVAL == 0:
            self.replace_model(self.model)
        schedule = self.schedule
        row, refine = self._row(step), None
        level = self.train[row].levels[schedule.level(step)]
        if self.refinement is not None:
            level = replace(level, camera=self.refinement.camera(row, level.camera))
            refine = partial(self.refinement.update, row, schedule.share(step))
        if step + 1 < schedule.steps:
            self.train[self._row(step + 1)].prefetch(schedule.level(step + 1))
        settings = self.raster_settings(schedule.active_sh_degree(step))
        if self.random_background:
            settings = replace(settings, background=schedule.background(step))
        rates = schedule.rates(step)
        dropout = None
        if self.dropout and not schedule.densifying(step):  # it would distort the mean gradients
            dropout = Dropout(len(self.train), schedule.dropout_key(step))
        weight = schedule.weight(step)
        given = StepInput(level, settings, rates, self.smooth, dropout, refine, weight)
        return self.stepper.step(given)

    def register_held_out(self) -> None:
        """Refine the camera of each held-out view on its own photograph, with the splats as they
        are. Otherwise it would be compared from where the training views are no longer. Raises
        Interrupted if the report asks to stop."""
        assert self.refinement is not None
        registered: list[EvaluationView] = []
        settings = self.raster_settings(self.schedule.sh_degree)
        for row, view in enumerate(self.held_out, len(self.train)):
            self.report.progress(len(registered), len(self.held_out), "registering")
            if self.report.stop_requested.is_set():
                raise Interrupted("stopped while registering held-out views")
            level = Level.from_pixels(view.camera, view.pixels, view.mask, view.outside)
            for number in range(REGISTRATION_STEPS):
                share = max(STARTS, number / REGISTRATION_STEPS)
                seen = replace(level, camera=self.refinement.camera(row, view.camera))
                refine = partial(self.refinement.update, row, share, with_lens=False)
                no_rates = LearningRates().scaled(0.0, 0.0)
                self.stepper.step(
                    StepInput(seen, settings, no_rates, self.smooth, use_gradients=refine)
                )
            registered.append(replace(view, camera=self.refinement.camera(row, view.camera)))
        self.held_out = registered

    def _row(self, step: int) -> int:
        """Which training view `step` uses."""
        return self.schedule.view(step, len(self.train))

    @property
    def dropout(self) -> bool:
        """Whether splats are dropped from steps once densification has ended."""
        return uses_dropout(len(self.train))

    @property
    def model(self) -> Model:
        """The current model, on the host; good until the next step."""
        return self.stepper.model()

    def replace_model(self, model: Model) -> None:
        """Go on with `model`, under new widths of the smoothing filter if it is used."""
        if self.smooth:
            model.smoothing[:] = self.smoothing_widths(model.means)
        self.stepper.load(model)

    def smoothing_widths(self, means: NDArray[np.floating]) -> NDArray[np.float32]:
        """[N] of the smoothing filter at positions [N, 3], from all training views at full size."""
        return smoothing_widths(means, self.cameras, self.draw_settings.near)

    @property
    def cameras(self) -> list[Camera]:
        """Of the training views, at full size."""
        cameras = [view.levels[-1].camera for view in self.train]
        if self.refinement is None:
            return cameras
        return [self.refinement.camera(row, camera) for row, camera in enumerate(cameras)]

    def raster_settings(self, sh_degree: int) -> RasterSettings:
        """To render the model with SH coefficients up to `sh_degree`."""
        drawn = self.draw_settings
        background = (drawn.background,) * 3
        return RasterSettings(
            drawn.near, antialias=drawn.antialias, background=background, sh_degree=sh_degree
        )

    def render(self, camera: Camera, sh_degree: int | None = None) -> NDArray[np.float32]:
        """[H, W, 3] of the current model, with all its SH coefficients or up to `sh_degree`."""
        degree = self.schedule.sh_degree if sh_degree is None else sh_degree
        return self.stepper.draw(camera, self.raster_settings(degree), self.smooth)

    def _resume(self, start: Splats) -> int:
        """Load the checkpoint's model, or else the initial one; how many steps it has had."""
        saved, step = load_checkpoint(self.folder, self.report.warn), 0
        if saved is None:
            model = initial_model(start, self.schedule.sh_degree, self.cap)
        else:
            model, state = most_opaque(saved[0], self.cap), saved[1]
            step, self.history, self.provenance = state.step, state.history, state.provenance
            *self.times, elapsed = state.times
            self.clock = Clock(elapsed)
            self.schedule = self.schedule.as_planned(*state.plan)
            if self.refinement is not None and state.refinement is not None:
                self.refinement.load(state.refinement)
            self.report.metric("resumed_from_step", step)
        now = Provenance.of_backend(step, self.backend)
        if changed := now.change_since(self.provenance):
            self.report.progress(step, self.schedule.steps, changed)
        if changed or not self.provenance:
            self.provenance.append(now)
        self.stepper.load(model)
        return step

    def save(self, step: int) -> None:
        """Write a checkpoint after `step` steps."""
        plan = (self.schedule.steps, *self.schedule.since)
        times = [*self.times, self.clock.elapsed()]
        refined = None if self.refinement is None else self.refinement.state()
        state = TrainingState(*(step, plan, self.history, times, self.provenance, refined))
        save_checkpoint(self.folder, self.model, state)

    def _lower_cap(self, fits: int) -> None:
        self.cap = lower_cap(self.folder, fits).splats
        self.report.progress(0, 1, f"the GPU's memory is full: going on with {fits:,} splats")
