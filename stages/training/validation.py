"""What depends on how well a capture's other views are matched: dropout, and early stopping.

Dropout follows a fixed rule: captures with fewer than DROPOUT_BELOW training views are overfitted
(their splats match the training views much better than views from elsewhere), so splats are dropped
from every step once densification has ended. With more views dropout costs quality.

Early stopping is used only if the user asks for it (--patience). Then a few training views are set
aside as validation views while the model is densified, and densification ends at the first
evaluation point at which no validation view has improved by the given PSNR over its best so far.
Afterwards the validation views are trained on like all others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from stages.measure.image_metrics import psnr
from stages.training.schedule import Schedule
from stages.training.views import target_of

if TYPE_CHECKING:
    from stages.training.trainer import Trainer

DROPOUT_BELOW = 15  # training views
MAX_VALIDATION_VIEWS = 4  # each further one costs training more than it helps
MIN_VIEWS_FOR_VALIDATION = 8  # with fewer, setting one aside costs too much
EVALUATIONS = 10  # evenly spaced over the run


def uses_dropout(views: int) -> bool:
    """Whether a run with this many training views overfits them, and so uses dropout."""
    return views < DROPOUT_BELOW


def validation_rows(views: int) -> tuple[int, ...]:
    """Which of `views` training views are set aside for early stopping: the fifth of every eight,
    which lies between the held-out views, or fewer where that would be more than
    MAX_VALIDATION_VIEWS; none of fewer than MIN_VIEWS_FOR_VALIDATION."""
    if views < MIN_VIEWS_FOR_VALIDATION:
        return ()
    return tuple(range(4, views, max(8, -(-views // MAX_VALIDATION_VIEWS))))


@dataclass
class EarlyStopping:
    """Decides when densification ends.

    Args:
        patience_db: the improvement of PSNR that at least one validation view must show.
        rows: of the validation views among the training views; () never stops.
        best_db: the best PSNR of each so far; [] before the first evaluation.
        stopped_at: number of steps after which densification was stopped; 0 if it was not.
    """

    patience_db: float = 0.0
    rows: tuple[int, ...] = ()
    best_db: list[float] = field(default_factory=list)
    stopped_at: int = 0

    def next_schedule(
        self, schedule: Schedule, step: int, psnr_of: Callable[[int], float]
    ) -> Schedule:
        """The schedule to follow after `step` steps. psnr_of(row): PSNR of a training view now."""
        due = schedule.densifying(step) and schedule.passes(step, EVALUATIONS)
        if not self.rows or not due:
            return schedule
        now = [psnr_of(row) for row in self.rows]
        before = self.best_db or [float("-inf")] * len(now)
        self.best_db = list(map(max, now, before))
        if any(a >= b + self.patience_db for a, b in zip(now, before, strict=True)):
            return schedule
        self.stopped_at = step
        return schedule.without_densification(step)

    def after_step(self, trainer: Trainer, step: int) -> None:
        """See `hooks.StepHook`."""
        trainer.schedule = self.next_schedule(
            trainer.schedule, step, lambda row: view_psnr_db(trainer, row)
        )


def view_psnr_db(trainer: Trainer, row: int) -> float:
    """PSNR of a training view with the current model, at full size."""
    level = trainer.train[row].levels[-1]
    image = np.clip(trainer.render(level.camera), 0.0, 1.0).transpose(2, 0, 1)
    target = target_of(level, image, (trainer.draw_settings.background,) * 3)
    return psnr(image, np.asarray(target, np.float32) / (255 if level.plain else 1))
