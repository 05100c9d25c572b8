"""Sentences for the report of `prune`: what was removed, at what cost, and why it stopped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.base.text import counted
from stages.prune.rounds import LOSS, RATE_DISTORTION, TIME, PruningResult
from stages.prune.targets import WORST_VIEW_DB, Targets
from stages.scene import TrainedSplats

_REASONS = {
    RATE_DISTORTION: "the remaining splats save more error than their bits cost",
    LOSS: "removing more would lose more than is allowed",
    TIME: "its share of --seconds was over",
}


def summarise(
    before: TrainedSplats, found: PruningResult, strength: float, finetune_steps: int
) -> list[str]:
    """One sentence or two each about the rate-distortion cost, the removal and its end.

    finetune_steps: done in all rounds."""
    cost, after, start = found.rate_distortion, found.splats, before.splats
    lines = [
        f"Rate-distortion: the training views hold {cost.samples:,} colour values, equivalent to "
        f"{cost.independent_samples:,.0f} independent ones. So a parameter costs "
        f"{cost.bits_per_parameter:.1f} bits, and one dB is worth {cost.bits_per_db / 8e3:,.0f} kB "
        f"(pruning strength {strength:g})."
    ]
    kept = [one for one in found.rounds if one.kept]
    if not kept:
        return [*lines, "Nothing was removed."]
    floaters = sum(one.floaters for one in kept)
    reduced = int((after.sh_degrees < start.sh_degree).sum())
    lines.append(
        f"Removed: {counted(len(start) - len(after), 'splat')} of {len(start):,}"
        f"{f' ({floaters:,} of them floaters)' if floaters else ''}; of the {len(after):,} left, "
        f"{reduced:,} have an SH degree below {start.sh_degree}. "
        f"{counted(len(kept), 'round')} with {counted(finetune_steps, 'step')} of fine-tuning: "
        f"{found.end_db - found.start_db:+.2f} dB on the training views."
    )
    reason = _REASONS.get(found.stopped_by, "all requested rounds were done")
    return [*lines, f"Pruning stopped because {reason}."]


def describe_loss(loss_db: NDArray[np.float64], targets: Targets) -> str:
    """A sentence about evaluated views that lost loss_db [V], more than the targets allow."""
    mean_db, worst_db = targets.strength * targets.max_loss_db, targets.strength * WORST_VIEW_DB
    return (
        f"The views that pruning is evaluated on lost {loss_db.mean():.2f} dB on average and "
        f"{loss_db.max():.2f} dB at worst, where {mean_db:.2g} and {worst_db:.2g} dB are allowed. "
        "A smaller --strength removes less."
    )


def advise_more_splats(found: PruningResult, strength: float) -> str:
    """A sentence for a model that is too small, otherwise "".

    A model is too small if nothing was removed and its least useful tenth is still worth its size:
    a further tenth would be worth less than this one."""
    if not found.rounds or any(one.kept and one.removed for one in found.rounds):
        return ""
    if found.least_tenth_db <= 0.01 * strength:
        return ""
    return (
        "No tenth of the splats can be removed: even the tenth that contributes least is worth "
        f"{found.least_tenth_db:.2f} dB, and another tenth would add at most as much. More splats "
        "would improve the pictures: train with a higher --max-splats."
    )
