"""Prunes a model in rounds: remove what contributes least, fine-tune the rest, measure, and undo a
round that cost too much.

What is removed minimises a rate-distortion cost, see `measure.rate_distortion`: the Lagrange
multiplier says how much squared error one parameter must save to be kept.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from stages.base.stage import Report
from stages.capacity.selection import ROUND_SHARE, Removal, select_removal
from stages.capacity.targets import Psnr, Targets
from stages.measure.contribution import Contributions, measure_contributions, squared_error
from stages.measure.evaluation import EvaluationView, image_renderer, psnr_of_views_db
from stages.measure.rate_distortion import RateDistortion, rate_distortion_of
from stages.scene import Splats, evenly_spaced
from stages.training.finetune import FineTuner

HALVINGS = 3  # of the share of splats that a round removes, after rounds that cost too much
# Splats that are removed together cost more than the sum of each alone, because they could replace
# each other: this factor at first, then what the last round measured whose predicted change was at
# least SIGNIFICANT (of the squared error).
OVERLAP, SIGNIFICANT = 1.25, 0.01
MAX_VIEWS = 48  # measured in a round; what the others showed at first goes on counting
HARM_TOLERANCE = 0.5  # of the predicted gain that removing harmful splats may miss
# Every eighth training view, from the fifth on, is a validation view: it takes no part in choosing
# what is removed, because what the others do not need may be seen there, as in new views. It is
# fine-tuned on like the others: without that it would lose 0.6 to 1.6 dB in 90 steps even if
# nothing were removed, where training overfits.
VALIDATION_FROM, VALIDATION_EVERY = 4, 8
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
        psnr_db: mean over the views, after fine-tuning.
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
        rounds: all that were tried.
    """

    splats: Splats
    rate_distortion: RateDistortion
    start_db: float
    end_db: float
    least_tenth_db: float
    stopped_by: str = ROUNDS
    rounds: list[PruningRound] = field(default_factory=list)

    def add_round(
        self, removal: Removal, predicted: float, measured: float, psnr_db: float, kept: bool
    ) -> None:
        """Record a round that started from `splats`."""
        reduced = (removal.degrees < self.splats.sh_degrees) & ~removal.removed
        self.rounds.append(
            PruningRound(
                splats=len(self.splats),
                removed=int(removal.removed.sum()),
                floaters=removal.floaters,
                sh_reduced=int(reduced.sum()),
                predicted_sse=round(predicted, 3),
                measured_sse=round(measured, 3),
                psnr_db=round(psnr_db, 4),
                kept=kept,
            )
        )


@dataclass(frozen=True)
class _State:
    """What is measured of a model.

    Args:
        choosing: contributions to the views that choose what is removed.
        validation: contributions to the validation views as they were at first, of the splats that
            are left: who sees what, for floaters.
        psnr_db: PSNR of the measured views that choose, and of the validation views if there are
            any, as they are now.
    """

    choosing: Contributions
    validation: Contributions
    psnr_db: tuple[Psnr, ...]


@dataclass
class Pruner:
    """Prunes a model in rounds.

    Args:
        views: training views. All are trained on. All but the validation views choose what is
            removed; of very many, `MAX_VIEWS` are measured in each round.
        targets: what pruning may cost and must reach.
        backend: name of the rasteriser.
        finetuner: on the same views.
        rounds: the largest number, unless a target needs more.
        finetune_steps: after each round; where a target needs more rounds, they share
            `rounds * finetune_steps` steps.
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
        every = range(len(self.views))
        validation = every[VALIDATION_FROM::VALIDATION_EVERY]
        choosing = sorted(set(every) - set(validation))
        self._measured = evenly_spaced(choosing, MAX_VIEWS)
        self._others = sorted(set(choosing) - set(self._measured))
        self._validation = evenly_spaced(validation, MAX_VIEWS)
        # in the order of `Contributions.scene_depth`, and then of the validation views
        rows = (*self._others, *self._measured, *self._validation)
        self._cameras = [self.finetuner.cameras[i] for i in rows]

    def prune(self, splats: Splats) -> PruningResult:
        """The smaller model. Raises SplatError for targets that cannot be met, and Interrupted."""
        state = self._measure_all(splats)
        best_db = state.psnr_db
        mean_db = _mean(best_db)
        self.targets.check_start(mean_db)
        rate_distortion = self._rate_distortion(splats)
        found = PruningResult(
            splats, rate_distortion, mean_db, mean_db, _least_tenth_db(state.choosing)
        )
        planned, share, overlap = self._planned_rounds(splats), ROUND_SHARE, OVERLAP
        if planned:
            state = self._remove_harmful(found, state)
            best_db = _better(best_db, state.psnr_db)
        for number in range(planned):
            self.report.progress(number, planned, "pruning", splats=len(found.splats))
            excess = self.targets.excess(found.splats)
            if excess <= 0 and time.monotonic() > self.deadline:
                found.stopped_by = TIME
                break
            removal = self._select(found, state, excess, share)
            if removal is None:
                found.stopped_by = RATE_DISTORTION
                break
            fewer = removal.apply(found.splats)
            measured = self._sse_change(fewer, state.choosing)
            steps = self.finetune_steps * self.rounds // planned
            allowed = None if excess > 0 else best_db
            fewer, after = self._finetuned(fewer, steps, state, removal, allowed)
            kept = excess > 0 or self.targets.allows(after.psnr_db, best_db)
            predicted = removal.predicted_sse * (overlap if removal.predicted_sse > 0 else 1)
            found.add_round(removal, predicted, measured, _mean(after.psnr_db), kept)
            if removal.predicted_sse > SIGNIFICANT * state.choosing.sse:
                overlap = max(1.0, measured / removal.predicted_sse)
            if kept:
                found.splats, state = fewer, after
                # what fine-tuning gains is not added to the loss allowed
                best_db = _better(best_db, after.psnr_db)
                continue
            share, found.stopped_by = share / 2, LOSS
            if share < ROUND_SHARE / 2**HALVINGS:
                break
        found.end_db = _mean(state.psnr_db)
        self.targets.check_end(found.splats, found.end_db)
        return found

    def _finetuned(
        self,
        splats: Splats,
        steps: int,
        before: _State,
        removal: Removal,
        best_db: tuple[Psnr, ...] | None,
    ) -> tuple[Splats, _State]:
        """The splats that `removal` left after so many steps, or as they are if only fine-tuning
        costs more than is allowed against `best_db`: of a model that was trained long on many
        photographs, 90 steps may cost all views 0.2 dB. best_db: None if any loss is."""
        counts = before.choosing.view_counts + before.validation.view_counts
        trained = self.finetuner.finetune(splats, steps, counts[~removal.removed])
        after = self._measure(trained, before, removal)
        if steps and best_db and not self.targets.allows(after.psnr_db, best_db):
            plain = self._measure(splats, before, removal)
            if self.targets.allows(plain.psnr_db, best_db):
                return splats, plain
        return trained, after

    def _remove_harmful(self, found: PruningResult, state: _State) -> _State:
        """Remove splats without which the views are matched better. Of those that seem so one by
        one, some are missed once all are gone: then fewer are removed."""
        share = ROUND_SHARE
        for _ in range(HALVINGS + 1):
            most = min(max(1, int(share * len(found.splats))), len(found.splats) - 1)
            removal = select_removal(
                found.splats,
                state.choosing,
                state.validation,
                self._cameras,
                -TINY,
                most,
                share,
                by_error=True,
            )
            if removal is None:
                return state
            fewer = removal.apply(found.splats)
            measured = self._sse_change(fewer, state.choosing)
            predicted = removal.predicted_sse
            after = self._measure(fewer, state, removal)
            kept = measured <= predicted + HARM_TOLERANCE * abs(predicted)
            views_db = [np.concatenate(one.psnr_db) for one in (after, state)]
            kept = kept and self.targets.allows(views_db[:1], views_db[1:])
            found.add_round(removal, predicted, measured, _mean(after.psnr_db), kept)
            if kept:
                found.splats = fewer
                return after
            share /= 2
        return state

    def _measured_views(self) -> Iterator[EvaluationView]:
        return (self.views[i] for i in self._measured)

    def _validation_views(self) -> Iterator[EvaluationView]:
        return (self.views[i] for i in self._validation)

    def _rate_distortion(self, splats: Splats) -> RateDistortion:
        measured = rate_distortion_of(image_renderer(splats, self.backend), self._measured_views())
        return measured.scaled(len(self.views) / max(1, len(self._measured)))

    def _measure_all(self, splats: Splats) -> _State:
        views = (self.views[i] for i in self._others)
        others = measure_contributions(splats, views, self.backend) if self._others else None
        validation = measure_contributions(splats, self._validation_views(), self.backend)
        return self._state(splats, others, validation)

    def _measure(self, splats: Splats, before: _State, removal: Removal) -> _State:
        others, kept = before.choosing.previous, ~removal.removed
        return self._state(splats, others and others.take(kept), before.validation.take(kept))

    def _state(
        self, splats: Splats, others: Contributions | None, validation: Contributions
    ) -> _State:
        found = measure_contributions(splats, self._measured_views(), self.backend, others)
        views_db = psnr_of_views_db(splats, self._validation_views(), self.backend)
        return _State(found, validation, (found.psnr_db, views_db)[: 1 + bool(len(views_db))])

    def _sse_change(self, splats: Splats, before: Contributions) -> float:
        """Change of the summed squared error of all views since `before`, from measured ones."""
        others = before.previous.sse if before.previous else 0.0
        measured = before.sse - others
        change = squared_error(splats, self._measured_views(), self.backend) - measured
        return change * (1 + others / max(measured, TINY))

    def _planned_rounds(self, splats: Splats) -> int:
        """As many as the size targets need, and a few more for what they leave."""
        left = len(splats) - self.targets.excess(splats)
        if left == len(splats):
            return self.rounds
        needed = math.log(left / len(splats)) / math.log(1 - ROUND_SHARE)
        return max(self.rounds, math.ceil(needed) + 4)

    def _select(
        self, found: PruningResult, state: _State, excess: int, share: float
    ) -> Removal | None:
        forced = excess > 0 or self.targets.min_psnr_db > 0
        limit = found.rate_distortion.sse_per_parameter * self.targets.strength
        most = max(1, int((ROUND_SHARE if excess else share) * len(found.splats)))
        most = min(most, excess or most, len(found.splats) - 1)
        return select_removal(
            found.splats,
            state.choosing,
            state.validation,
            self._cameras,
            math.inf if forced else limit,
            most,
            share,
        )


def _mean(psnr_db: Sequence[Psnr]) -> float:
    return float(np.concatenate(psnr_db).mean())


def _better(one: tuple[Psnr, ...], other: tuple[Psnr, ...]) -> tuple[Psnr, ...]:
    """Of each group of views, the PSNR with the larger mean."""
    return tuple(max(pair, key=np.mean) for pair in zip(one, other, strict=True))


def _least_tenth_db(state: Contributions) -> float:
    """Loss if the tenth of the splats with the smallest contributions were removed, as if the
    effects of single removals added up."""
    change = np.sort(state.sse_change)[: max(1, len(state.sse_change) // 10)].sum()
    return 10 * math.log10(max(1e-12, 1 + float(change) / state.sse)) if state.sse else 0.0
