"""Whether splats shall sit steps out (`dropout`) from where growth ends.

Where few photographs are learnt by heart it is worth more than a decibel, and elsewhere it costs a
third of one. How steeply lent photographs rise tells little: it moves with the seed by as much as
captures differ. So they are asked outright: training goes on for a while both ways, from the same
splats and on the same photographs, and keeps the one by which the lent ones come out better.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.training.schedule import GROWTH_ENDS, Schedule

# Of the run, either way: so long that no seed of a carpet is taken for what it is not, and over
# before the next tenth of the run, when its course is told.
LASTS = 0.09
SURE_DB = 0.05  # where it is by heart more than 0.2 dB, elsewhere -0.3 to 0.0
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
