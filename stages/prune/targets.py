"""Targets of pruning: the loss allowed and the size wanted, and errors where these conflict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import UsageError
from stages.base.text import counted
from stages.scene import Splats

Psnr = NDArray[np.float64]  # of each view, or a difference, dB
# What views that are trained on may lose, of what is promised for others, which lose a quarter more
# where nothing is overfitted (0.097 dB for 0.076 with 72 photographs, 0.40 for 0.35 with 255).
MARGIN = 0.75
WORST_VIEW_DB = 0.3  # that any one view may lose, at strength 1


@dataclass(frozen=True)
class Targets:
    """What pruning may cost, and what it must reach.

    Args:
        strength: factor of the Lagrange multiplier and of the loss allowed.
        max_loss_db: mean loss of the views, at strength 1.
        max_splats, max_bytes, min_psnr_db: these override the strength; 0 for none.
        size_bytes: gives the size of the file that `max_bytes` is about.
        least_bytes: its size with one splat.
    """

    strength: float
    max_loss_db: float
    max_splats: int
    max_bytes: float
    min_psnr_db: float
    size_bytes: Callable[[Splats], int]
    least_bytes: int = 0

    def excess(self, splats: Splats) -> int:
        """How many splats are too many for the size targets."""
        count = len(splats)
        allowed = self.max_splats or count
        size = self.size_bytes(splats) if self.max_bytes else 0
        if size > self.max_bytes:
            share = max(0, self.max_bytes - self.least_bytes) / max(1, size - self.least_bytes)
            allowed = min(allowed, 1 + int((count - 1) * share))
        return count - max(1, min(allowed, count))

    def allows(self, psnr_db: Psnr, best_db: Psnr) -> bool:
        """Whether training views may have `psnr_db` where they had `best_db`, with `MARGIN` for
        views that are not trained on."""
        if self.min_psnr_db:
            return float(psnr_db.mean()) >= self.min_psnr_db
        return self.used(best_db - psnr_db) <= 1

    def used(self, loss_db: Psnr) -> float:
        """What training views lose [V], as a share of what they may."""
        mean, worst = (float(f(loss_db)) / (MARGIN * self.strength) for f in (np.mean, np.max))
        return max(mean / max(self.max_loss_db, 1e-9), worst / WORST_VIEW_DB)

    def broken_by(self, loss_db: Psnr) -> bool:
        """Whether held-out views lose more than the strength allows. loss_db: [V]."""
        return self.used(MARGIN * loss_db) > 1

    def check_start(self, psnr_db: float) -> None:
        """Raises SplatError (prune-psnr-not-reached) if even the unpruned model is below."""
        if self.min_psnr_db > psnr_db:
            raise UsageError(
                "prune-psnr-not-reached",
                given=f"--min-psnr {self.min_psnr_db:g}, but all trained splats together reach "
                f"{psnr_db:.2f} dB on the training views.",
                wanted=f"At most {np.floor(psnr_db * 100) / 100:.2f}.",
                hint="Pruning only removes splats. For a higher PSNR train longer, or with more "
                "splats.",
            )

    def check_end(self, splats: Splats, psnr_db: float) -> None:
        """Raises SplatError (prune-too-small, prune-targets-contradict)."""
        if self.max_bytes:
            check_size(self.max_bytes, self.size_bytes(splats), len(splats))
        if self.min_psnr_db > psnr_db:
            raise UsageError(
                "prune-targets-contradict",
                given=f"--min-psnr {self.min_psnr_db:g} and the requested size contradict each "
                f"other: {counted(len(splats), 'splat')} reach {psnr_db:.2f} dB.",
                wanted="Targets that this scene can meet together.",
                hint=f"Ask for --min-psnr {np.floor(psnr_db * 100) / 100:.2f}, or allow more.",
            )


def check_size(max_bytes: float, size_bytes: int, count: int) -> None:
    """Raises SplatError (prune-too-small) if `count` splats, in a file of `size_bytes`, take more
    than `max_bytes`."""
    if size_bytes > max_bytes:
        raise UsageError(
            "prune-too-small",
            given=f"--max-mb {max_bytes / 1e6:g} is less than {counted(count, 'splat')} "
            f"{'takes' if count == 1 else 'take'}.",
            wanted=f"At least {np.ceil(size_bytes / 1e3) / 1000:g}.",
            hint="Ask for more megabytes, or for another format with --mb-of.",
        )
