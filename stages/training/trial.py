"""What the photographs that training lends are asked: whether splats shall sit steps out from where
growth ends, and whether it shall have grown so far at all.

Where few photographs are learnt by heart, sitting out is worth more than a decibel, and elsewhere
it costs a third of one; and splats that are added explain the photographs trained on, not the
scene. How lent photographs rise on the way tells neither: they waver by more than there is to know.
So they are asked outright: from where it stands, training settles as at its end, in few steps,
without and with splats sitting out, and looks at them; then all of that is forgotten. It is asked
where growth ends, and in a long run wherever growth has gone on for as long again: where that gave
less than was wished, training goes back to the model of the last time, and ends its growth there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stages.training.schedule import GROWTH_ENDS, Schedule

MOST_STEPS = 200  # either way
LASTS = 1 / 15  # of the run at most, either way
EARLIEST = 1500  # steps: fewer are cheap, and say little of what more would give
TIMES = 4  # at most, each at twice the steps of the one before
# From DOUBT_DB on splats sit out: to do so where it is not wanted costs 0.3 dB at most, and to miss
# it 2 dB. From SURE_DB on it is by heart, and `prune` may take what only these photographs show.
DOUBT_DB, SURE_DB = 0.0, 0.05


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


@dataclass(frozen=True)
class Answer:
    """What lent photographs would have come to had training ended from `step` on, with `splats`:
    without and with splats sitting out."""

    step: int
    splats: int
    plain_db: float
    sitting_out_db: float

    @property
    def gain_db(self) -> float:
        """What sitting out gives."""
        return self.sitting_out_db - self.plain_db

    @property
    def best_db(self) -> float:
        return max(self.plain_db, self.sitting_out_db)


def trial_at(step: int, schedule: Schedule) -> Trial | None:
    """The one that begins after `step` steps, if any."""
    before, now = schedule.share(step - 1), schedule.share(step)
    shares = [GROWTH_ENDS / 2**k for k in range(TIMES)]
    due = [share for share in shares if before < share <= now]
    ends = step + max(1, min(MOST_STEPS, round(LASTS * schedule.steps)))
    if not due or ends >= schedule.steps or (due[0] < GROWTH_ENDS and step < EARLIEST):
        return None
    return Trial(step, ends)


def gives_too_little(answers: Sequence[Answer], patience_db: float) -> bool:
    """Whether growing on since the answer before the last gave less than patience_db, if that is
    asked for."""
    if len(answers) < 2 or not patience_db:
        return False
    return answers[-1].best_db - answers[-2].best_db < patience_db
