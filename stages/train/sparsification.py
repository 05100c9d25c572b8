"""After densification, rounds of training remove the splats without which the training pictures
would change least. The steps that are left repair what the removal costs.

The pictures decide how many. A round may change them by as much as lowers their PSNR by its part
of `LOSS_DB`, if the changes by single splats add up and are not correlated with the present error.
Beyond that go splats that lower the error of the training views by less than so many free
parameters do where they fit noise: see `spare_error`. With few photographs these are many. So a
scene keeps the splats that it needs, whatever the cap was.

GaussianSpa (Zhang et al. 2025) removes splats during training by an optimisation that drives their
opacities to zero. Here splats are chosen by how much the pictures would change, as in
`prune.rounds`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.evaluate.contribution import MAX_MEASURED_VIEWS, measure_contributions
from stages.evaluate.evaluation import EvaluationView
from stages.evaluate.selection import RemovalLimits, select_removal
from stages.raster.smoothing import smoothed
from stages.scene import Splats, evenly_spaced, parameters_per_splat
from stages.train.cap import pixel_values
from stages.train.conversion import splats_of, valid_rows
from stages.train.density import DensityRule
from stages.train.optimiser import Model, empty_model
from stages.train.trainer import Trainer
from stages.train.views import Level

SHARES = (0.52, 0.63, 0.74, 0.85)  # of the run, after which a round happens
LARGEST_ROUND = 0.2  # of the splats
LOSS_DB = 0.1  # PSNR of the training views that all rounds together may cost


@dataclass(frozen=True)
class Sparsification:
    """Removes splats that contribute least to the training views.

    Args:
        start: of the run; has the origin of the coordinates.
        density: what densifies; splats outside its region stay.
    """

    start: Splats
    density: DensityRule

    def after_step(self, trainer: Trainer, step: int) -> None:
        """See `hooks.StepHook`."""
        before, now = trainer.schedule.share(step - 1), trainer.schedule.share(step)
        if not any(before < share <= now for share in SHARES):
            return
        model = trainer.model.on_host()
        trainer.stepper.load(empty_model())  # a device may not hold the model twice
        model = model.take(valid_rows(model))
        trainer.replace_model(self._sparser(trainer, model))

    def _sparser(self, trainer: Trainer, model: Model) -> Model:
        """The model after one round."""
        task = trainer.task
        splats = splats_of(model, trainer.schedule.sh_degree, self.start, task.draw_settings)
        if task.smooth:
            splats = smoothed(splats, model.smoothing)
        rows = evenly_spaced(range(len(task.views)), MAX_MEASURED_VIEWS)
        cameras, background = list(trainer.cameras), task.draw_settings.background
        views = (_evaluation_view(task.views[r].name, trainer.level(r), background) for r in rows)
        contributions = measure_contributions(splats, views, task.backend, truncation=False)
        change = contributions.sse * (10 ** (LOSS_DB / len(SHARES) / 10) - 1)
        parameters = int(parameters_per_splat(splats.sh_degrees).sum())
        spare = spare_error(contributions.sse, pixel_values(cameras), parameters)
        most = int(LARGEST_ROUND * len(splats))
        every = len(rows) == len(task.views)
        limits = RemovalLimits(np.inf, most, change=change, spare=spare, complete=every)
        removal = select_removal(splats, contributions, cameras, limits)
        if removal is None:
            return model
        return model.take(~removal.removed | ~self.density.inside(model))


def spare_error(sse: float, values: int, parameters: int) -> float:
    """The summed squared error that one more parameter must save, or it lowers the error of the
    training views and not that of others.

    Generalised cross-validation (Craven and Wahba 1979) estimates the error of values that took no
    part as S n / (n - p)^2, up to a constant. Without a splat of q parameters S grows by its
    change D of the pictures, and the estimate falls where D < 2 S q / (n - p).

    Args:
        sse: S, of the measured training views.
        values: n, of all training views.
        parameters: p, of all splats; where they are no fewer than the values, any may go.
    """
    return 2.0 * sse / max(1, values - parameters)


def _evaluation_view(name: str, level: Level, background: float) -> EvaluationView:
    pixels = np.ascontiguousarray(level.pixels.transpose(1, 2, 0))
    photograph = EvaluationView(name, level.camera, pixels, level.mask, level.outside)
    return photograph.in_median_light(level.light).over(background)
