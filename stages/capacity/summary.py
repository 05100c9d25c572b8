"""What was cut, why, what it cost, and whether more would pay, in sentences."""

from __future__ import annotations

from stages.base.text import counted
from stages.capacity.pruning import LOSS, PRICE, PruningResult
from stages.capacity.targets import felt_share
from stages.scene import TrainedSplats

_WHY = {
    PRICE: "what is left is worth its bits",
    LOSS: "cutting more would lose more than is allowed",
}


def summarise(
    before: TrainedSplats, found: PruningResult, dial: float, finetune_steps: int
) -> list[str]:
    """dial: the price that was asked for."""
    price, after, start = found.price, found.splats, before.splats
    told = [
        f"Price: the photographs of training hold {price.samples:,} colour values, worth "
        f"{price.independent_samples:,.0f} independent ones; so a number costs "
        f"{price.bits_per_parameter:.1f} bits, and one dB is worth "
        f"{price.bits_per_db / 8e3:,.0f} kB (dial at {dial:g})."
    ]
    kept = [one for one in found.rounds if one.kept]
    if not kept:
        return [*told, "Nothing was cut."]
    floaters = sum(one.floaters for one in kept)
    poorer = int((after.sh_degrees < start.sh_degree).sum())
    told.append(
        f"Cut: {counted(len(start) - len(after), 'splat')} of {len(start):,}"
        f"{f' ({floaters:,} of them floaters)' if floaters else ''}; of the {len(after):,} left, "
        f"{poorer:,} have fewer bands of colour than {start.sh_degree}. "
        f"{counted(len(kept), 'round')} with {counted(finetune_steps, 'step')} of fine-tuning in "
        f"all: {found.end_db - found.start_db:+.2f} dB on the photographs of training; other views "
        f"feel at most {felt_share(before.overfitted):.0%} of that."
    )
    why = _WHY.get(found.stopped_by, "the rounds that were asked for were done")
    return [*told, f"It stopped since {why}."]


def more_would_pay(found: PruningResult, dial: float) -> str:
    """The sentence, or "" where it would not: the tenth of the splats that is worth least, before
    anything was cut, against what as many cost; a next tenth would be worth less than this one."""
    if not found.rounds or any(one.kept and one.removed for one in found.rounds):
        return ""
    return (
        "No tenth of the splats can be spared: the least of them is worth "
        f"{found.least_tenth_db:.2f} dB, and a next tenth would buy at most as much. More splats "
        "would pay: train with a higher --max-splats."
        if found.least_tenth_db > 0.01 * dial
        else ""
    )
