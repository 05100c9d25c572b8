"""Prunes a model in rounds: remove what contributes least, measure, and undo a round that cost too
much. Rounds that a target needs are kept whatever they cost, and fine-tuned.

What is removed minimises a rate-distortion cost, see `evaluate.rate_distortion`: the Lagrange
multiplier says how much squared error, summed over the views' colour values in 0..1, one parameter
must save to be kept. `evaluate.selection` chooses, `targets` bounds the loss (dB).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from stages.base.stage import Report
from stages.evaluate.contribution import (
    MAX_MEASURED_VIEWS,
    Contributions,
    measure_contributions,
)
from stages.evaluate.evaluation import EvaluationView, image_renderer
from stages.evaluate.rate_distortion import RateDistortion, rate_distortion_of
from stages.evaluate.selection import BEYOND, ROUND_SHARE, Removal, RemovalLimits, select_removal
from stages.prune.targets import Psnr, Targets
from stages.scene import Splats, evenly_spaced
from stages.train.finetune import FineTuner

SMALLEST_SHARE = ROUND_SHARE / 8  # of the splats, that a round removes
# A round that is predicted to cost too much is planned again with fewer splats: as many as cost AIM
# of what is allowed, if the loss grows with this power of their number.
AIM, POWER = 0.95, 1.6
PESSIMISM = 1.15  # x the predicted loss, before a round was refused: neighbours miss each other
TINY = float(np.finfo(np.float64).tiny)
# why pruning stopped
RATE_DISTORTION, LOSS, ROUNDS, TIME = "rate_distortion", "loss", "rounds", "time"


@dataclass(frozen=True)
class PruningRound:
    """One round, for the report.

    Args:
        splats: before it.
        removed, floaters: how many splats it removed, and how many of them are floaters.
        sh_reduced: splats that stayed with a lower SH degree.
        predicted_sse, measured_sse: change of the summed squared error by the removal alone.
        psnr_db: mean over the views, after fine-tuning if there was any.
        kept: False if the round was undone.
    """

    splats: int
    removed: int
    floaters: int
    sh_reduced: int
    predicted_sse: float
    measured_sse: float
    psnr_db: float
    kept: bool


@dataclass
class PruningResult:
    """The pruned model and how it came about.

    Args:
        splats: what is left.
        rate_distortion: at the start.
        start_db, end_db: mean PSNR of the measured views.
        least_tenth_db: what the tenth of the splats that contributes least contributed at first.
        stopped_by: RATE_DISTORTION (the rest saves more bits than it costs), LOSS, TIME
            or ROUNDS.
        forced: whether a target kept a round that cost more than is allowed.
        rounds: all that were tried.
    """

    splats: Splats
    rate_distortion: RateDistortion
    start_db: float
    end_db: float
    least_tenth_db: float
    stopped_by: str = ROUNDS
    forced: bool = False
    rounds: list[PruningRound] = field(default_factory=list)

    def add_round(self, removal: Removal, measured_sse: float, psnr_db: Psnr, kept: bool) -> None:
        """Record a round that started from `splats`."""
        reduced = (removal.degrees < self.splats.sh_degrees) & ~removal.removed
        self.rounds.append(
            PruningRound(
                splats=len(self.splats),
                removed=int(removal.removed.sum()),
                floaters=removal.floaters,
                sh_reduced=int(reduced.sum()),
                predicted_sse=round(removal.predicted_sse, 3),
                measured_sse=round(measured_sse, 3),
                psnr_db=round(float(psnr_db.mean()), 4),
                kept=kept,
            )
        )


@dataclass
class Pruner:
    """Prunes a model in rounds.

    Args:
        views: training views. All are trained on and choose what is removed; of very many,
            `MAX_MEASURED_VIEWS` are measured in each round.
        targets: what pruning may cost and must reach.
        backend: name of the rasteriser.
        finetuner: on the same views.
        rounds: the largest number, unless a target needs more.
        finetune_steps: after each round that a target needs.
        report: for progress.
        deadline: after which no round begins, as `time.monotonic`, unless a target needs it.
    """

    views: Sequence[EvaluationView]
    targets: Targets
    backend: str
    finetuner: FineTuner
    rounds: int
    finetune_steps: int
    report: Report
    deadline: float = math.inf

    def __post_init__(self) -> None:
        every, self._pessimism = range(len(self.views)), PESSIMISM
        self._measured = evenly_spaced(every, MAX_MEASURED_VIEWS)
        self._others = sorted(set(every) - set(self._measured))
        # in the order of `Contributions.scene_depth`
        self._cameras = [self.finetuner.cameras[i] for i in (*self._others, *self._measured)]

    def prune(self, splats: Splats) -> PruningResult:
        """The smaller model. Raises SplatError for targets that cannot be met, and Interrupted."""
        state = self._measure_all(splats)
        best_db = state.psnr_db
        mean_db = float(best_db.mean())
        self.targets.check_start(mean_db)
        rate_distortion = self._rate_distortion(splats)
        found = PruningResult(splats, rate_distortion, mean_db, mean_db, _least_tenth_db(state))
        planned, share = self._planned_rounds(splats), ROUND_SHARE
        if planned:
            state = self._remove_unneeded(found, state)
            best_db = max(best_db, state.psnr_db, key=np.mean)
        for number in range(planned):
            self.report.progress(number, planned, "pruning", splats=len(found.splats))
            excess = self.targets.excess(found.splats)
            if excess <= 0 and time.monotonic() > self.deadline:
                found.stopped_by = TIME
                break
            removal, share = self._affordable(found, state, best_db, excess, share)
            if removal is None:
                found.stopped_by = RATE_DISTORTION if share >= SMALLEST_SHARE else LOSS
                break
            fewer = removal.apply(found.splats)
            after = self._measure(fewer, state, removal)
            measured = self._sse_change(state, after)
            kept = self.targets.allows(after.psnr_db, best_db)
            if excess > 0 or (self.targets.min_psnr_db and not kept):
                fewer, after = self._finetuned(fewer, after)
                kept = self.targets.allows(after.psnr_db, best_db)
                found.forced |= excess > 0 and not kept
                kept |= excess > 0
            found.add_round(removal, measured, after.psnr_db, kept)
            if kept:
                found.splats, state = fewer, after
                # what fine-tuning gains is not added to the loss allowed
                best_db = max(best_db, after.psnr_db, key=np.mean)
                continue
            predicted, used = (
                self.targets.used(best_db - db)
                for db in (self._predicted_db(state, removal), after.psnr_db)
            )
            self._pessimism *= max(1.0, used / max(predicted, TINY))
            share, found.stopped_by = share / 2, LOSS
        found.end_db = float(state.psnr_db.mean())
        self.targets.check_end(found.splats, found.end_db)
        return found

    def _remove_unneeded(self, found: PruningResult, state: Contributions) -> Contributions:
        """Remove floaters, and splats that no view shows, whatever else may go."""
        most = len(found.splats) - 1
        removal = select_removal(found.splats, state, self._cameras, RemovalLimits(0.0, most))
        if removal is None:
            return state
        fewer, kept = removal.apply(found.splats), True
        after, measured = state.take(~removal.removed), removal.predicted_sse
        if removal.floaters:  # the others do not show
            after = self._measure(fewer, state, removal)
            kept = self.targets.allows(after.psnr_db, state.psnr_db)
            measured = self._sse_change(state, after)
        found.add_round(removal, measured, after.psnr_db, kept)
        if not kept:
            return state
        found.splats = fewer
        return after

    def _finetuned(self, splats: Splats, before: Contributions) -> tuple[Splats, Contributions]:
        """The fine-tuned splats, and their contributions. before: those of `splats`."""
        if not self.finetune_steps:
            return splats, before
        trained = self.finetuner.finetune(splats, self.finetune_steps, before.view_counts)
        return trained, self._contributions(trained, before.previous)

    def _measured_views(self) -> Iterator[EvaluationView]:
        return (self.views[i] for i in self._measured)

    def _rate_distortion(self, splats: Splats) -> RateDistortion:
        measured = rate_distortion_of(image_renderer(splats, self.backend), self._measured_views())
        return measured.scaled(len(self.views) / max(1, len(self._measured)))

    def _measure_all(self, splats: Splats) -> Contributions:
        views = (self.views[i] for i in self._others)
        others = None
        if self._others:
            others = measure_contributions(splats, views, self.backend, beyond=BEYOND)
        return self._contributions(splats, others)

    def _measure(self, splats: Splats, before: Contributions, removal: Removal) -> Contributions:
        others = before.previous
        return self._contributions(splats, others and others.take(~removal.removed))

    def _contributions(self, splats: Splats, others: Contributions | None) -> Contributions:
        views = self._measured_views()
        return measure_contributions(splats, views, self.backend, others, beyond=BEYOND)

    @staticmethod
    def _sse_change(before: Contributions, after: Contributions) -> float:
        """Change of the summed squared error of all views, from measured ones."""
        others = before.previous.sse if before.previous else 0.0
        measured = before.sse - others
        change = after.sse - before.sse
        return change * (1 + others / max(measured, TINY))

    def _planned_rounds(self, splats: Splats) -> int:
        """As many as the targets need, and a few more for what they leave. Without a size target a
        PSNR may need as many as remove all, unless no rounds are wanted."""
        count = len(splats)
        left = count - self.targets.excess(splats)
        if self.targets.min_psnr_db and self.rounds:
            left = min(left, 1)
        if left >= count:
            return self.rounds
        needed = math.log(left / count) / math.log(1 - ROUND_SHARE)
        return max(self.rounds, math.ceil(needed) + 4)

    def _affordable(
        self, found: PruningResult, state: Contributions, best_db: Psnr, excess: int, share: float
    ) -> tuple[Removal | None, float]:
        """(what the next round removes, its share of the splats): the largest removal whose
        predicted loss is allowed, or one that a target needs; None if there is none."""
        while share >= SMALLEST_SHARE:
            removal = self._select(found, state, excess, share)
            if removal is None or excess > 0 or self.targets.min_psnr_db:
                return removal, share
            predicted_db = self._predicted_db(state, removal)
            if self.targets.allows(predicted_db, best_db):
                return removal, share
            before, used = (self.targets.used(best_db - db) for db in (state.psnr_db, predicted_db))
            left = AIM * max(0.0, 1.0 - before) / max(used - before, TINY)
            share *= min(0.9, left ** (1 / POWER))
        return None, share

    def _predicted_db(self, state: Contributions, removal: Removal) -> Psnr:
        ratio = 1 + removal.predicted_sse / max(state.sse, TINY)
        return state.psnr_db - self._pessimism * 10 * math.log10(max(ratio, TINY))

    def _select(
        self, found: PruningResult, state: Contributions, excess: int, share: float
    ) -> Removal | None:
        forced = excess > 0 or self.targets.min_psnr_db > 0
        limit = found.rate_distortion.sse_per_parameter * self.targets.strength
        most = max(1, int((ROUND_SHARE if excess else share) * len(found.splats)))
        most = min(most, excess or most, len(found.splats) - 1)
        limit = math.inf if forced else limit
        limits = RemovalLimits(limit, most, share)
        return select_removal(found.splats, state, self._cameras, limits)


def _least_tenth_db(state: Contributions) -> float:
    """Loss if the tenth of the splats with the smallest contributions were removed, as if the
    effects of single removals added up."""
    change = np.sort(state.sse_change)[: max(1, len(state.sse_change) // 10)].sum()
    return 10 * math.log10(max(1e-12, 1 + float(change) / state.sse)) if state.sse else 0.0
