"""What the photographs that training lends are asked: whether splats shall sit steps out from where
growth ends, and whether it shall have grown so far at all.

Where few photographs are learnt by heart, sitting out is worth more than a decibel, and elsewhere
it costs a third of one; and splats that are added explain the photographs trained on, not the
scene. How lent photographs rise on the way tells neither: they waver by more than there is to know.
So they are asked outright: from where it stands, training settles as at its end, in few steps,
without and with splats sitting out, and looks at them; then all of that is forgotten. It is asked
where growth ends; and in a long run, if somebody wants no more than pays, wherever growth has gone
on for as long again. Where that gave none of them what was wished, training goes back to the model
of the last time, and ends its growth there. One that gained is enough to go on: those lent lie
between others, and gain far less than views from elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from stages.training.schedule import GROWTH_ENDS, Schedule

MOST_STEPS = 200  # either way
LASTS = 1 / 15  # of the run at most, either way
EARLIEST = 1500  # steps: fewer are cheap, and say little of what more would give
TIMES = 4  # at most, each at twice the steps of the one before
# From DOUBT_DB on, that is in doubt, splats sit out: to do so where it is not wanted costs 0.3 dB,
# and to miss it 2 dB. From SURE_DB on it is by heart, and `prune` may take what only these
# photographs show.
DOUBT_DB, SURE_DB = -0.05, 0.05


@dataclass(frozen=True)
class Trial:
    """One under way, from step `begun` to step `ends`. plain_db: what each of the lent photographs
    came to without anything sitting out; () while that way is still being gone."""

    begun: int
    ends: int
    plain_db: tuple[float, ...] = ()

    @property
    def dropout(self) -> bool:
        """Whether splats sit out on the way that is being gone."""
        return bool(self.plain_db)


@dataclass(frozen=True)
class Answer:
    """What each of the lent photographs would have come to had training ended from `step` on, with
    `splats`: without and with splats sitting out."""

    step: int
    splats: int
    plain_db: tuple[float, ...]
    sitting_out_db: tuple[float, ...]

    @property
    def gain_db(self) -> float:
        """What sitting out gives, on the average."""
        return fmean(self.sitting_out_db) - fmean(self.plain_db)

    @property
    def best_db(self) -> tuple[float, ...]:
        return max(self.plain_db, self.sitting_out_db, key=fmean)

    def gained_db(self, before: Answer) -> float:
        """By the photograph that gained most since then."""
        return max(now - then for now, then in zip(self.best_db, before.best_db, strict=True))


def trial_at(step: int, schedule: Schedule, often: bool) -> Trial | None:
    """The one that begins after `step` steps, if any. often: not only where growth ends."""
    before, now = schedule.share(step - 1), schedule.share(step)
    shares = [GROWTH_ENDS / 2**k for k in range(TIMES if often else 1)]
    due = [share for share in shares if before < share <= now]
    ends = step + max(1, min(MOST_STEPS, round(LASTS * schedule.steps)))
    if not due or ends >= schedule.steps or (due[0] < GROWTH_ENDS and step < EARLIEST):
        return None
    return Trial(step, ends)


def gives_too_little(answers: Sequence[Answer], patience_db: float) -> bool:
    """Whether growing on since the answer before the last gave none of them patience_db."""
    return len(answers) > 1 and answers[-1].gained_db(answers[-2]) < patience_db
