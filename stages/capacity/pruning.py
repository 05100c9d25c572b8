"""Round by round: cut what is worth least, fine-tune, measure, and take back what cost too much."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from stages.base.stage import Report
from stages.capacity.selection import SPLATS_A_ROUND, Removal, choose
from stages.capacity.targets import Targets
from stages.measure.contribution import Contributions, measure_contributions, squared_error
from stages.measure.evaluation import EvaluationView, image_renderer
from stages.measure.rate_distortion import RateDistortion, rate_distortion_of
from stages.scene import Splats, evenly_spaced
from stages.training.finetune import FineTuner

BACK_OFFS = 3  # times that a round may ask for half as much
# Splats that go together cost more than the sum of each alone, since they stood in for each other:
# this much at first, then what the last round told that cost enough to tell.
OVERLAP, TELLING = 1.25, 0.01  # TELLING: of the squared error
LOOKED_AT = 48  # photographs in a round; what the others told at first goes on counting
TINY = float(np.finfo(np.float64).tiny)
WRONG = 0.5  # of what taking out harm should save: so much less may come of it
PRICE, LOSS, ROUNDS = "price", "loss", "rounds"  # why it stopped


@dataclass(frozen=True)
class Round:
    """One round as it was tried. splats: before. predicted_sse, measured_sse: change of the squared
    error by the cut alone, foretold and drawn. psnr_db: mean over the photographs, fine-tuned;
    of harm that stays, as it was. kept: or taken back."""

    splats: int
    removed: int
    floaters: int
    bands_cut: int
    predicted_sse: float
    measured_sse: float
    psnr_db: float
    kept: bool


@dataclass
class PruningResult:
    """What came of it. start_db, end_db: mean over the photographs that decide. stopped_by: PRICE
    (what is left pays), LOSS or ROUNDS. least_tenth_db: what the tenth of the splats that is worth
    least was worth at the start."""

    splats: Splats
    price: RateDistortion
    start_db: float
    end_db: float
    least_tenth_db: float
    stopped_by: str = ROUNDS
    rounds: list[Round] = field(default_factory=list)


@dataclass
class Pruner:
    """One model on its way down. rounds: at most, unless targets want more. tune_steps: after each
    of as many; where targets want more rounds, they share the steps. All photographs tell what it
    learns and what each splat is worth at first, as many as `LOOKED_AT` decide."""

    photographs: Sequence[EvaluationView]
    targets: Targets
    backend: str
    tuner: FineTuner
    rounds: int
    finetune_steps: int
    report: Report

    def __post_init__(self) -> None:
        every = range(len(self.photographs))
        self.decide = evenly_spaced(every, LOOKED_AT)
        self.others = sorted(set(every) - set(self.decide))
        # in the order in which worth tells of photographs
        self.cameras = [self.tuner.cameras[i] for i in (*self.others, *self.decide)]

    def run(self, splats: Splats) -> PruningResult:
        """The smaller model. Raises SplatError for targets that cannot be met, and Interrupted."""
        worth = self._first_worth(splats)
        best = worth.psnr_db
        mean_db = float(best.mean())
        self.targets.check_start(mean_db)
        price = rate_distortion_of(
            image_renderer(splats, self.backend), self._pictures(self.decide)
        )
        price = price.scaled(len(self.photographs) / max(1, len(self.decide)))
        found = PruningResult(splats, price, mean_db, mean_db, _least_tenth_db(worth))
        planned, share, overlap = self._planned(splats), SPLATS_A_ROUND, OVERLAP
        if planned:
            worth = self._without_harm(found, worth)
            best = max(best, worth.psnr_db, key=np.mean)
        for number in range(planned):
            self.report.progress(number, planned, "pruning", splats=len(found.splats))
            excess = self.targets.excess(found.splats)
            cut = self._cut(found, worth, excess, share)
            if cut is None:
                found.stopped_by = PRICE
                break
            fewer, seen = cut.of(found.splats), worth.view_counts[~cut.gone]
            measured = squared_error(fewer, self._pictures(self.decide), self.backend)
            measured = (measured - _fresh_sse(worth)) * _told_by(worth)
            fewer = self.tuner.finetune(fewer, self.finetune_steps * self.rounds // planned, seen)
            after = self._worth(fewer, worth, cut)
            kept = excess > 0 or self.targets.holds(after.psnr_db, best)
            predicted = cut.predicted_sse * (overlap if cut.predicted_sse > 0 else 1)
            told = (predicted, measured, float(after.psnr_db.mean()), kept)
            found.rounds.append(_round(found.splats, cut, *told))
            if cut.predicted_sse > TELLING * worth.sse:
                overlap = max(1.0, measured / cut.predicted_sse)
            if kept:
                found.splats, worth = fewer, after
                # what removing harm and learning on win is not there to be spent
                best = max(best, after.psnr_db, key=np.mean)
                continue
            share, found.stopped_by = share / 2, LOSS
            if share < SPLATS_A_ROUND / 2**BACK_OFFS:
                break
        found.end_db = float(worth.psnr_db.mean())
        self.targets.check_end(found.splats, found.end_db)
        return found

    def _without_harm(self, found: PruningResult, worth: Contributions) -> Contributions:
        """Take out what the photographs are better without. Fewer, where they turn out to be missed
        together: drawing tells."""
        share = SPLATS_A_ROUND
        for _ in range(BACK_OFFS + 1):
            most = max(1, int(share * len(found.splats)))
            limits = (self.cameras, -TINY, min(most, len(found.splats) - 1))
            cut = choose(found.splats, worth, *limits, share, harm=True)
            if cut is None:
                return worth
            fewer = cut.of(found.splats)
            measured = squared_error(fewer, self._pictures(self.decide), self.backend)
            measured = (measured - _fresh_sse(worth)) * _told_by(worth)
            kept = measured <= cut.predicted_sse + WRONG * abs(cut.predicted_sse)
            after = self._worth(fewer, worth, cut) if kept else worth
            told = (cut.predicted_sse, measured, float(after.psnr_db.mean()), kept)
            found.rounds.append(_round(found.splats, cut, *told))
            if kept:
                found.splats = fewer
                return after
            share /= 2
        return worth

    def _pictures(self, numbers: list[int]) -> Iterator[EvaluationView]:
        return (self.photographs[i] for i in numbers)

    def _first_worth(self, splats: Splats) -> Contributions:
        others = None
        if self.others:
            others = measure_contributions(splats, self._pictures(self.others), self.backend)
        return measure_contributions(splats, self._pictures(self.decide), self.backend, others)

    def _worth(self, splats: Splats, before: Contributions, cut: Removal) -> Contributions:
        others = before.previous.take(~cut.gone) if before.previous else None
        return measure_contributions(splats, self._pictures(self.decide), self.backend, others)

    def _planned(self, splats: Splats) -> int:
        """As many rounds as targets need, and a few for what they leave over."""
        left = len(splats) - self.targets.excess(splats)
        if left == len(splats):
            return self.rounds
        needed = math.log(left / len(splats)) / math.log(1 - SPLATS_A_ROUND)
        return max(self.rounds, math.ceil(needed) + 4)

    def _cut(
        self, found: PruningResult, worth: Contributions, excess: int, share: float
    ) -> Removal | None:
        forced = excess > 0 or self.targets.min_psnr_db > 0
        limit = math.inf if forced else self.targets.price * found.price.sse_per_parameter
        most = max(1, int((SPLATS_A_ROUND if excess else share) * len(found.splats)))
        most = min(most, excess, len(found.splats) - 1) if excess else most
        return choose(
            found.splats, worth, self.cameras, limit, min(most, len(found.splats) - 1), share
        )


def _fresh_sse(worth: Contributions) -> float:
    """Of the photographs that decide."""
    return worth.sse - (worth.previous.sse if worth.previous else 0.0)


def _told_by(worth: Contributions) -> float:
    """How much larger a change is of all photographs than of those that decide."""
    return 1 + (worth.previous.sse if worth.previous else 0.0) / max(_fresh_sse(worth), TINY)


def _round(
    before: Splats, cut: Removal, predicted: float, measured: float, psnr_db: float, kept: bool
) -> Round:
    return Round(
        splats=len(before),
        removed=int(cut.gone.sum()),
        floaters=cut.floaters,
        bands_cut=int(((cut.degrees < before.sh_degrees) & ~cut.gone).sum()),
        predicted_sse=round(predicted, 3),
        measured_sse=round(measured, 3),
        psnr_db=round(psnr_db, 4),
        kept=kept,
    )


def _least_tenth_db(worth: Contributions) -> float:
    """By the worth of each alone."""
    change = np.sort(worth.sse_change)[: max(1, len(worth.sse_change) // 10)].sum()
    return 10 * math.log10(max(1e-12, 1 + float(change) / worth.sse)) if worth.sse else 0.0
