"""Targets of pruning: the loss allowed and the size wanted, and errors where these conflict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.base.text import counted
from stages.scene import Splats

WORST_VIEW_DB = 0.3  # that any one view may lose, at strength 1
# Loss of other views per loss of training views, at most. Measured with half of the splats removed
# and the rest fine-tuned: 0 on an overfitted carpet, 0.15 on a toy, 0.2 on the sample.
LOSS_RATIO, LOSS_RATIO_OVERFITTED = 0.25, 0.05


def held_out_loss_ratio(overfitted: bool) -> float:
    """Upper bound of the loss of other views (dB) per dB that training views lose."""
    return LOSS_RATIO_OVERFITTED if overfitted else LOSS_RATIO


@dataclass(frozen=True)
class Targets:
    """What pruning may cost, and what it must reach.

    Args:
        strength: factor of the Lagrange multiplier and of the loss allowed.
        max_loss_db: mean loss of views that were not trained on, at strength 1.
        loss_ratio: see `held_out_loss_ratio`.
        max_splats, max_bytes, min_psnr_db: these override the strength; 0 for none.
        size_bytes: gives the size of the file that `max_bytes` is about.
    """

    strength: float
    max_loss_db: float
    loss_ratio: float
    max_splats: int
    max_bytes: float
    min_psnr_db: float
    size_bytes: Callable[[Splats], int]

    def excess(self, splats: Splats) -> int:
        """How many splats are too many for the size targets."""
        count = len(splats)
        allowed = self.max_splats or count
        if self.max_bytes:
            size = self.size_bytes(splats)
            if size > self.max_bytes:
                allowed = min(allowed, int(count * self.max_bytes / size))
        return count - max(1, min(allowed, count))

    def allows(self, psnr_db: NDArray[np.float64], best_db: NDArray[np.float64]) -> bool:
        """Whether V training views may have `psnr_db` [V] where they had `best_db` [V]."""
        if self.min_psnr_db:
            return float(psnr_db.mean()) >= self.min_psnr_db
        loss = (best_db - psnr_db) * self.loss_ratio / self.strength
        return float(loss.mean()) <= self.max_loss_db and float(loss.max()) <= WORST_VIEW_DB

    def check_start(self, psnr_db: float) -> None:
        """Raises SplatError (prune-psnr-not-reached) if even the unpruned model is below."""
        if self.min_psnr_db > psnr_db:
            raise SplatError(
                "prune-psnr-not-reached",
                given=f"--min-psnr {self.min_psnr_db:g}, but all trained splats together reach "
                f"{psnr_db:.2f} dB on the training views.",
                wanted=f"At most {np.floor(psnr_db * 100) / 100:.2f}.",
                hint="Pruning only removes splats. For a higher PSNR train longer, or with more "
                "splats.",
                family=Family.USAGE,
            )

    def check_end(self, splats: Splats, psnr_db: float) -> None:
        """Raises SplatError (prune-too-small, prune-targets-contradict)."""
        size = self.size_bytes(splats) if self.max_bytes else 0
        if size > self.max_bytes:
            raise SplatError(
                "prune-too-small",
                given=f"--max-mb {self.max_bytes / 1e6:g} is less than "
                f"{counted(len(splats), 'splat')} take.",
                wanted=f"At least {np.ceil(size / 1e4) / 100:g}.",
                hint="Ask for more megabytes, or for another format with --mb-of.",
                family=Family.USAGE,
            )
        if self.min_psnr_db > psnr_db:
            raise SplatError(
                "prune-targets-contradict",
                given=f"--min-psnr {self.min_psnr_db:g} and the requested size contradict each "
                f"other: {counted(len(splats), 'splat')} reach {psnr_db:.2f} dB.",
                wanted="Targets that this scene can meet together.",
                hint=f"Ask for --min-psnr {np.floor(psnr_db * 100) / 100:.2f}, or allow more.",
                family=Family.USAGE,
            )
