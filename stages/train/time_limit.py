"""A limit of wall time (seconds): how many training steps fit into it."""

from __future__ import annotations

from dataclasses import dataclass

from stages.train.trainer import Trainer

PLANS = 50  # plans of a run, at most
PLAN_STEPS = 10  # fewer do not show how long a step takes
# The final evaluation with FLIP and the writing of results, in durations of one evaluation.
FINAL_EVALUATION = 8.0


@dataclass
class TimeLimit:
    """Keeps a run within `seconds` of wall time by changing its number of steps.

    Each plan measures how long a step took since the last plan, so it follows larger images, more
    splats and other load on the machine. The first step, in which kernels are compiled, is left
    out.

    Args:
        seconds: the limit; 0 for none.
        most_steps: of the run; 0 for any number.
        reserve: seconds of it that are kept for what follows the last step.
        steps_after: the last one, on held-out views.
    """

    seconds: float
    most_steps: int = 0
    reserve: float = 0.0
    steps_after: int = 0
    _last: tuple[int, float] | None = None

    def steps(self, step: int, elapsed: float) -> int | None:
        """How many steps in all fit, if `step` steps took `elapsed` seconds; None for no new
        plan."""
        if self._last is None:
            self._last = step, elapsed
            return None
        steps, seconds = step - self._last[0], elapsed - self._last[1]
        if steps < PLAN_STEPS or seconds < self.seconds / PLANS:
            return None
        self._last = step, elapsed
        left = self.seconds - self.reserve - elapsed
        fitting = step + max(1, int(left * steps / seconds) - self.steps_after)
        return min(fitting, self.most_steps) if self.most_steps else fitting

    def reserve_for_end(self, evaluation_seconds: float) -> None:
        """Keep time for the end of a run in which one evaluation took so long."""
        self.reserve = FINAL_EVALUATION * evaluation_seconds

    def after_step(self, trainer: Trainer, step: int) -> None:
        """See `hooks.StepHook`."""
        if not self.seconds or step == trainer.schedule.steps:
            return
        if steps := self.steps(step, trainer.clock.elapsed().seconds):
            trainer.replan(step, steps)
