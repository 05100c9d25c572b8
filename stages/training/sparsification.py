"""After densification, four rounds of training remove together a third of the splats: those without
which the training pictures change least. The steps that are left train the others to replace them.

Each round measures contributions (`measure.contribution`, [N]) and removes the tenth that
`measure.selection` chooses, floaters first, as in pruning. GaussianSpa (Zhang et al. 2025) removes
splats in training, too, but drives opacities to zero by an optimisation of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.measure.contribution import measure_contributions
from stages.measure.evaluation import EvaluationView
from stages.measure.selection import ROUND_SHARE, select_removal
from stages.raster.smoothing import smoothed
from stages.scene import Camera, Splats, evenly_spaced
from stages.training.conversion import splats_of, valid_rows
from stages.training.density import BoundedDensity
from stages.training.optimiser import Model, empty_model

if TYPE_CHECKING:
    from stages.training.density import AdaptiveDensity
    from stages.training.trainer import Trainer
    from stages.training.views import TrainingView

# Shares of the run after which a tenth of the splats is removed. Together they remove a third.
SHARES = (0.52, 0.63, 0.74, 0.85)
MAX_VIEWS = 48  # on which contributions are measured


@dataclass(frozen=True)
class Sparsification:
    """Removes splats that contribute least to the training views, see `SHARES`.

    Args:
        start: of the run; has the origin of the coordinates.
        density: what densifies; splats outside its bounds stay.
    """

    start: Splats
    density: AdaptiveDensity | BoundedDensity

    def after_step(self, trainer: Trainer, step: int) -> None:
        """See `hooks.StepHook`."""
        before, now = trainer.schedule.share(step - 1), trainer.schedule.share(step)
        if not any(before < share <= now for share in SHARES):
            return
        model = trainer.model
        trainer.stepper.load(empty_model())  # a device may not hold the model twice
        model = model.take(valid_rows(model))
        trainer.replace_model(self._sparser(trainer, model))

    def _sparser(self, trainer: Trainer, model: Model) -> Model:
        """The model without a tenth of its splats."""
        splats = splats_of(model, trainer.schedule.sh_degree, self.start, trainer.draw_settings)
        if trainer.smooth:
            splats = smoothed(splats, model.smoothing)
        most = int(ROUND_SHARE * len(splats))
        if not most:
            return model
        rows = evenly_spaced(range(len(trainer.train)), MAX_VIEWS)
        cameras = [trainer.cameras[row] for row in rows]
        views = map(_evaluation_view, [trainer.train[row] for row in rows], cameras)
        contributions = measure_contributions(splats, views, trainer.backend)
        removal = select_removal(splats, contributions, cameras, np.inf, most)
        if removal is None:
            return model
        removed = removal.removed
        if isinstance(self.density, BoundedDensity):
            removed &= self.density.inside(model)
        return model.take(~removed)


def _evaluation_view(view: TrainingView, camera: Camera) -> EvaluationView:
    level = view.levels[-1]
    pixels = np.ascontiguousarray(level.pixels.transpose(1, 2, 0))
    return EvaluationView(view.name, camera, pixels, level.mask, level.outside)
