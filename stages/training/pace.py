"""How many steps fit into a time, and whether what is left is worth its time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

PLANS = 50  # times, at most, that a run with a time limit is planned anew
PLAN_STEPS = 10  # fewer do not show a pace
PLATEAU_POINTS = 10  # the line is laid through as many marks
SURE = 1.0  # standard errors of its slope that are added to what is expected


@dataclass
class Pace:
    """Keeps a run within `seconds` of wall time, of which `reserve` are wanted after the last step.
    Each plan asks how long a step takes since the last one, so it follows pictures that become
    larger, splats that become more, and a machine that is needed elsewhere. The first steps, in
    which kernels are compiled, tell nothing."""

    seconds: float
    reserve: float = 0.0
    _last: tuple[int, float] | None = None

    def steps(self, step: int, spent: float) -> int | None:
        """Steps in all that fit, when `step` are done after `spent` seconds; None: no new plan."""
        if self._last is None:
            self._last = step, spent
            return None
        since, lasted = step - self._last[0], spent - self._last[1]
        if since < PLAN_STEPS or lasted < self.seconds / PLANS:
            return None
        self._last = step, spent
        left = self.seconds - self.reserve - spent
        return step + max(1, int(left * since / lasted))


def remaining_gain_db(marks: Sequence[tuple[int, float]], end: int) -> float:
    """What going on to step `end` may still give, at most: by a line through the last of `marks`,
    (step, PSNR in dB), over the logarithm of the steps, with the slope's standard error added.
    Infinite while there are too few.

    Quality in training rises by about as much with each doubling, or less; a straight line is the
    careful guess.
    """
    if len(marks) < PLATEAU_POINTS:
        return float("inf")
    steps, y = np.array(marks[-PLATEAU_POINTS:], float).T
    x = np.log(steps)
    x0 = x - x.mean()
    slope = float(x0 @ y / (x0 @ x0))
    residual = y - y.mean() - slope * x0
    error = float(np.sqrt(residual @ residual / (PLATEAU_POINTS - 2) / (x0 @ x0)))
    return (slope + SURE * error) * float(np.log(end / steps[-1]))
