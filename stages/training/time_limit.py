"""How many steps fit into a time."""

from __future__ import annotations

from dataclasses import dataclass

PLANS = 50  # times, at most, that a run with a time limit is planned anew
PLAN_STEPS = 10  # fewer do not show a pace


@dataclass
class TimeLimit:
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
