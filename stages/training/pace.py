"""How many steps fit into a time, and whether what is left is worth its time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

PLANS = 50  # times, at most, that a run with a time limit is planned anew
PLAN_STEPS = 10  # fewer do not show a pace
PLATEAU_POINTS = 10  # the line is laid through as many marks
BY_HEART = 0.25  # of each dB gained: where less is passed on, hardly anybody else gains
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

    def restart(self) -> None:
        """Look at the pace anew: steps were made that do not count."""
        self._last = None


@dataclass(frozen=True)
class Mark:
    """What photographs came out as after `step` steps: mean PSNR in dB of those that are lent, and
    of as many that are not."""

    step: int
    lent_db: float
    told_db: float


def share_passed_on(marks: Sequence[Mark]) -> float:
    """Of each dB that photographs in training gained over the last marks, what those lent gained,
    0 to 1. 1 while there are too few marks to tell, and where training gains nothing."""
    if len(marks) < PLATEAU_POINTS:
        return 1.0
    last = marks[-PLATEAU_POINTS:]
    lent, _ = _slope(last, [mark.lent_db for mark in last])
    told, _ = _slope(last, [mark.told_db for mark in last])
    return float(np.clip(lent / told, 0.0, 1.0)) if told > 0 else 1.0


def remaining_gain_db(marks: Sequence[Mark], end: int) -> float:
    """What going on to step `end` may still give to the photographs lent, at most: by a line
    through their last marks over the logarithm of the steps, with the slope's standard error added.
    Infinite while there are too few.

    Quality in training rises by about as much with each doubling, or less; a straight line is the
    careful guess.
    """
    if len(marks) < PLATEAU_POINTS:
        return float("inf")
    last = marks[-PLATEAU_POINTS:]
    slope, error = _slope(last, [mark.lent_db for mark in last])
    return (slope + SURE * error) * float(np.log(end / last[-1].step))


def _slope(marks: Sequence[Mark], values_db: Sequence[float]) -> tuple[float, float]:
    """(dB for each e-fold of the steps, its standard error) of the line through the values."""
    x, y = np.log([mark.step for mark in marks]), np.asarray(values_db)
    x0 = x - x.mean()
    slope = float(x0 @ y / (x0 @ x0))
    residual = y - y.mean() - slope * x0
    return slope, float(np.sqrt(residual @ residual / (len(x) - 2) / (x0 @ x0)))
