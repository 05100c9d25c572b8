"""What is wanted of a smaller model, and what to say where it cannot be had."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.base.text import counted
from stages.scene import Splats

WORST_VIEW_DB = 0.3  # that any one view may lose, at price 1
# With half of the splats gone and the rest fine-tuned, other views lost, of what photographs in
# training lost, nothing on a carpet that is learnt by heart, 0.15 on a toy, 0.2 on the sample.
FELT, FELT_BY_HEART = 0.25, 0.05


def felt_share(overfitted: bool) -> float:
    """How much of what training photographs lose other views lose as well, at most."""
    return FELT_BY_HEART if overfitted else FELT


@dataclass(frozen=True)
class Targets:
    """price: what a number must be worth, in units of what the photographs ask; the loss allowed
    grows with it. max_loss_db: at price 1, mean over views that were not trained on. felt: see
    `felt_share`. max_splats, max_bytes, min_psnr_db: targets that override the price; 0 for none.
    size_bytes: of the file that max_bytes speaks of."""

    price: float
    max_loss_db: float
    felt: float
    max_splats: int
    max_bytes: float
    min_psnr_db: float
    size_bytes: Callable[[Splats], int]

    def excess(self, splats: Splats) -> int:
        """How many splats are too many for the targets."""
        count = len(splats)
        allowed = self.max_splats or count
        if self.max_bytes:
            size = self.size_bytes(splats)
            if size > self.max_bytes:
                allowed = min(allowed, int(count * self.max_bytes / size))
        return count - max(1, min(allowed, count))

    def holds(self, psnr_db: NDArray[np.float64], best_db: NDArray[np.float64]) -> bool:
        """Whether photographs [P] of training may look like this, and `best_db` before."""
        if self.min_psnr_db:
            return float(psnr_db.mean()) >= self.min_psnr_db
        loss = (best_db - psnr_db) * self.felt / self.price
        return float(loss.mean()) <= self.max_loss_db and float(loss.max()) <= WORST_VIEW_DB

    def check_start(self, psnr_db: float) -> None:
        """Raises SplatError (prune-psnr-not-reached) where even the whole model is not as good."""
        if self.min_psnr_db > psnr_db:
            raise SplatError(
                "prune-psnr-not-reached",
                given=f"--min-psnr {self.min_psnr_db:g}, and all splats that were trained reach "
                f"{psnr_db:.2f} dB on the photographs of training.",
                wanted=f"At most {np.floor(psnr_db * 100) / 100:.2f}.",
                hint="Pruning only takes away: train longer, or with more splats, for more.",
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
                given=f"--min-psnr {self.min_psnr_db:g} and the size asked for cannot both be had: "
                f"{counted(len(splats), 'splat')} reach {psnr_db:.2f} dB.",
                wanted="Targets that this scene can meet together.",
                hint=f"Ask for --min-psnr {np.floor(psnr_db * 100) / 100:.2f}, or allow more.",
                family=Family.USAGE,
            )
