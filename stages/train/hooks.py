"""What happens between training steps, each as one object with one method. `step_hooks` lists them
in their order. Splats are removed by three: `FloaterRemoval`, `Densification` and `Sparsification`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.evaluate.evaluation import EvaluationView, evaluate, evaluation_subset
from stages.raster.backends import backend_of, rasteriser_of
from stages.raster.draw import rendering_of
from stages.scene import Camera, Splats
from stages.train.average import AVERAGED_FROM, PARTS, ParameterAverage
from stages.train.colour_refit import ColourRefit, needs_colour_refit
from stages.train.density import (
    AdaptiveDensity,
    BoundedDensity,
    DensityRule,
    cull,
    gradient_threshold,
)
from stages.train.free_space import FreeSpace, known_free_space
from stages.train.optimiser import empty_model
from stages.train.schedule import HALF_SIZE_END, QUARTER
from stages.train.sparsification import Sparsification
from stages.train.time_limit import TimeLimit
from stages.train.trainer import REGISTRATION_STEPS, Trainer
from stages.train.transients import Comparison, transient_parts

CHECKPOINT_SECONDS = 30.0
EVALUATIONS, EVALUATED = 10, 12  # evenly spaced over the run; held-out views in each, at most
FLOATER_REMOVALS = 20  # during a run, evenly spaced


class StepHook(Protocol):
    """Something that happens between steps."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        """Is called when `step` steps are done."""


def step_hooks(trainer: Trainer, start: Splats) -> list[StepHook]:
    """All hooks of a run that starts from `start`, in the order in which they are called."""
    task = trainer.task
    adaptive = AdaptiveDensity(len(task.views))
    density: DensityRule = BoundedDensity(adaptive, task.within) if task.within else adaptive
    # Of many held-out views a part is evaluated, so that it takes less time than training.
    views = [task.held_out[i] for i in evaluation_subset(len(task.held_out), EVALUATED)]
    registered = REGISTRATION_STEPS * len(task.held_out) if trainer.refinement is not None else 0
    time_limit = TimeLimit(task.seconds, task.most_steps, steps_after=registered)
    # of the cameras before their refinement, which a resumed run has, too
    free_space = known_free_space(start.means, [v.levels[-1].camera for v in task.views])
    return [
        Transients(),
        Averaging(),
        FloaterRemoval(free_space),
        Densification(density),
        Curvature(),
        Sparsification(start, density),
        FinalColourRefit(),
        Evaluation(views, time_limit),
        time_limit,
        Checkpointing(),
        Progress(),
        LivePreview(),
    ]


@dataclass(frozen=True)
class Transients:
    """Once, before the run draws at full size, decides which parts of photographs show what moved,
    see `transients`; training ignores them from then on."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        if trainer.transient or trainer.schedule.share(step) < HALF_SIZE_END:
            return
        views = trainer.task.views
        settings = trainer.raster_settings(trainer.schedule.active_sh_degree(step))
        rasteriser = rasteriser_of(backend_of(trainer.task.backend).name)
        arrays = rasteriser.loaded(trainer.model.on_host().drawn(trainer.task.smooth))
        compared = []
        for view, camera in zip(views, trainer.cameras, strict=True):
            level = view.levels[QUARTER]
            size = level.camera.width, level.camera.height
            level = replace(level, camera=camera.resized(*size))
            drawn = rendering_of(rasteriser.forward(arrays, level.camera, settings, depths=True))
            compared.append(Comparison.of(level, drawn, settings.background))
        trainer.transient = transient_parts(compared)
        trainer.stepper.forget_views()


@dataclass(frozen=True)
class Averaging:
    """Averages the parameters over the end of the run, see `average`."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        schedule = trainer.schedule
        if schedule.share(step) <= AVERAGED_FROM or not schedule.passes(step, PARTS):
            return
        model = trainer.model.on_host()
        trainer.average.add(model)
        if step == schedule.steps:
            trainer.replace_model(trainer.average.written_to(model))
            trainer.average = ParameterAverage()


@dataclass(frozen=True)
class FloaterRemoval:
    """Removes floaters a few times during the run, see `free_space`, but while an average is made,
    which needs the same splats."""

    free_space: FreeSpace

    def after_step(self, trainer: Trainer, step: int) -> None:
        if trainer.schedule.passes(step, FLOATER_REMOVALS) and not trainer.average.count:
            model = trainer.model
            trainer.replace_model(model.take(~model.in_free_space(self.free_space)))


@dataclass(frozen=True)
class Densification:
    """Applies adaptive density control at the steps that the schedule names."""

    density: DensityRule

    def after_step(self, trainer: Trainer, step: int) -> None:
        schedule = trainer.schedule
        if not schedule.densifies_after(step - 1):
            return
        model = cull(trainer.model)
        cap = trainer.cap.splats  # it may have fallen below the plan
        budget = min(schedule.budget(step - 1, cap), cap)
        model = self.density.grow(model, budget, gradient_threshold(schedule.steps))
        trainer.replace_model(model.in_morton_order())


@dataclass(frozen=True)
class Curvature:
    """When densification has ended, forgets Adam's second moment, whose place the curvature takes:
    see `gauss_newton`."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        schedule = trainer.schedule
        if schedule.densifying(step) or not schedule.densifying(step - 1):
            return
        model = trainer.model
        model.reset_moment2()
        trainer.replace_model(model)


@dataclass(frozen=True)
class FinalColourRefit:
    """Fits the colours to all training views at the end, see `colour_refit`."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        last = step == trainer.schedule.steps
        if not last or not needs_colour_refit(trainer.task.dropout, len(trainer.task.views)):
            return
        model = trainer.model.on_host()
        trainer.stepper.load(empty_model())  # a device may not hold the model twice
        refit = ColourRefit(
            rasteriser_of(backend_of(trainer.task.backend).name),
            trainer.raster_settings(trainer.schedule.sh_degree),
            lambda: map(trainer.level, range(len(trainer.task.views))),
            trainer.task.smooth,
        )
        trainer.stepper.load(refit.of(model))


@dataclass(frozen=True)
class Evaluation:
    """Evaluates held-out views at the evaluation points and enters the result in the history."""

    views: list[EvaluationView]
    time_limit: TimeLimit

    def after_step(self, trainer: Trainer, step: int) -> None:
        if not trainer.schedule.passes(step, EVALUATIONS):
            return
        began = trainer.clock.elapsed().seconds
        scores = evaluate(trainer.render, self.views)
        elapsed = trainer.clock.elapsed()
        all_views = len(trainer.task.held_out) / max(1, len(self.views))
        self.time_limit.reserve_for_end(all_views * (elapsed.seconds - began))
        trainer.history.add(step, len(trainer.stepper), scores, elapsed)


@dataclass
class Checkpointing:
    """Writes a checkpoint every CHECKPOINT_SECONDS, before it raises Interrupted if the report
    asks to stop, and after the last step, since what follows may be interrupted, too."""

    last: float = field(default_factory=time.monotonic)

    def after_step(self, trainer: Trainer, step: int) -> None:
        steps = trainer.schedule.steps
        stops = trainer.task.report.stop_requested.is_set() and step < steps
        if stops or step == steps or time.monotonic() - self.last > CHECKPOINT_SECONDS:
            trainer.save(step)
            self.last = time.monotonic()
        if stops:
            raise Interrupted(f"train stopped after step {step} of {steps}")


@dataclass(frozen=True)
class Progress:
    """Reports the progress of the run."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        numbers: dict[str, float | int | str] = {
            "splats": len(trainer.stepper),
            "loss": round(trainer.loss, 4),
        }
        if (psnr_db := trainer.history.last_psnr_db) is not None:
            numbers["held_out_psnr_db"] = round(psnr_db, 2)
        trainer.task.report.progress(step, trainer.schedule.steps, "training", **numbers)


@dataclass(frozen=True)
class LivePreview:
    """Offers to render the current model, with the SH coefficients that are trained by now."""

    def after_step(self, trainer: Trainer, step: int) -> None:
        degree = trainer.schedule.active_sh_degree(step - 1)

        def draw(camera: Camera) -> NDArray[np.uint8]:
            image = np.clip(trainer.render(camera, degree), 0.0, 1.0)
            return np.rint(image * 255).astype(np.uint8)

        trainer.task.report.offer(draw)
