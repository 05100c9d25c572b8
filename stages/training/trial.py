"""Whether splats shall sit steps out (`dropout`) from where growth ends.

Where few photographs are learnt by heart it is worth more than a decibel, and elsewhere it costs a
third of one. How steeply lent photographs rise tells little: it moves with the seed by as much as
captures differ. So they are asked outright: training goes on for a while both ways, from the same
splats and on the same photographs, and keeps the one by which the lent ones come out better. In
doubt splats sit out: where that is wrong it costs less than where it is missed.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.training.schedule import GROWTH_ENDS, Schedule

LASTS = 0.09  # of the run, either way: over before the next tenth, when its course is told
# What lent photographs gain is 0.0 to 3 dB on a carpet that is learnt by heart, 0.0 on a toy and a
# fern, which hardly notice, and -0.35 to -0.25 on the sample.
DOUBT_DB, SURE_DB = -0.1, 0.05  # from here on splats sit out; from here on it is by heart
BEFORE, PLAIN = "before-trial", "plain-way"  # what the models of these moments are kept as


@dataclass(frozen=True)
class Trial:
    """One under way, from step `begun` to step `ends`. plain_db: what lent photographs came to
    without anything sitting out; None while that way is still being gone."""

    begun: int
    ends: int
    plain_db: float | None = None

    @property
    def sits_out(self) -> bool:
        """Whether splats sit out on the way that is being gone."""
        return self.plain_db is not None


def trial_at(step: int, schedule: Schedule) -> Trial | None:
    """The one that begins after `step` steps, if growth has ended by then and anything is left to
    be trained after it."""
    ends = step + max(1, round(LASTS * schedule.steps))
    if schedule.share(step) < GROWTH_ENDS or ends >= schedule.steps:
        return None
    return Trial(step, ends)
