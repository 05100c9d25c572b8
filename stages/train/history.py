"""The evaluations during a run, and the time at each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from stages.evaluate.evaluation import Score
from stages.train.clock import Elapsed


@dataclass(frozen=True)
class HistoryEntry:
    """One evaluation: after how many steps, of how many splats, and the means over the held-out
    views (dB; None where nothing is held out)."""

    step: int
    splats: int
    psnr_db: float | None = None
    ssim: float | None = None

    @property
    def figures(self) -> dict[str, Any]:
        """The fields that have a value, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass
class History:
    """entries: equal in equal runs. times: of each entry; these differ."""

    entries: list[HistoryEntry] = field(default_factory=list)
    times: list[Elapsed] = field(default_factory=list)

    def add(self, step: int, splats: int, scores: Sequence[Score], elapsed: Elapsed) -> None:
        """Enter an evaluation on the held-out views, which gave `scores`."""
        psnr_db = ssim = None
        scores = [score for score in scores if score.counts]
        if scores:
            psnr_db = float(np.mean([score.psnr_db for score in scores]))
            ssim = float(np.mean([score.ssim for score in scores]))
        self.entries.append(HistoryEntry(step, splats, psnr_db, ssim))
        self.times.append(elapsed)

    @property
    def last_psnr_db(self) -> float | None:
        """Of the last evaluation; None before the first one."""
        return self.entries[-1].psnr_db if self.entries else None

    @property
    def largest_fall_db(self) -> tuple[float, int]:
        """(by how much the PSNR fell at most below its best value before, dB; at which step)."""
        best, fall, step = -math.inf, 0.0, 0
        for entry in self.entries:
            if entry.psnr_db is not None:
                best = max(best, entry.psnr_db)
                if best - entry.psnr_db > fall:
                    fall, step = best - entry.psnr_db, entry.step
        return fall, step

    @property
    def most_splats(self) -> int:
        """The largest number of splats at an evaluation."""
        return max((entry.splats for entry in self.entries), default=0)
