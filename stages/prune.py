"""Stage 5: take out floaters and splats that no photograph needs; prove that it cost nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.stage import Report, Stage
from stages.raster.backends import backend_of, backend_setting

if TYPE_CHECKING:
    from stages.measure.judge import Photograph
    from stages.scene import Reconstruction, Splats

SHARE_A_ROUND = 0.10  # predictions for single splats add up only while few go at once
BACK_OFFS = 5


@dataclass(frozen=True)
class PruneSettings:
    rounds: int = field(
        default=2, metadata={"help": "Rounds of pruning, 0 for none.", "min": 0, "max": 100}
    )
    max_loss_db: float = field(
        default=0.05,
        metadata={
            "help": "PSNR of the training photographs that pruning may cost in all (dB).",
            "min": 0,
            "max": 100,
        },
    )
    backend: str = backend_setting()


def run(inputs: Mapping[str, Any], settings: PruneSettings, folder: Path, report: Report) -> Splats:
    """Fewer splats, written to `folder`; counts and PSNR before and after into the report."""
    import numpy as np

    from stages.measure.judge import load_photographs, mean_psnr_db
    from stages.scene import split_held_out
    from stages.scene.storage import save_splats

    reconstruction: Reconstruction = inputs["sfm"]
    splats: Splats = inputs["train"]
    kept, held = split_held_out(reconstruction.views)
    photographs = load_photographs(reconstruction.folder, kept, splats.look)
    judges = load_photographs(reconstruction.folder, held, splats.look) or photographs
    before = mean_psnr_db(splats, judges, settings.backend)
    floor = mean_psnr_db(splats, photographs, settings.backend) - settings.max_loss_db
    start, counts = len(splats), {"floaters": 0, "unneeded": 0}
    for number in range(settings.rounds):
        report.progress(number, settings.rounds, "pruning", splats=len(splats))
        splats, found = _one_round(splats, photographs, settings.backend, floor)
        for name, count in found.items():
            counts[name] += count
        if not sum(found.values()):
            break
    after = mean_psnr_db(splats, judges, settings.backend)
    report.metric("backend", backend_of(settings.backend).name)
    report.metric("judged_side_px", splats.look.side)
    report.metric("splats_before", start)
    report.metric("splats", len(splats))
    report.metric("floaters_removed", counts["floaters"])
    report.metric("unneeded_removed", counts["unneeded"])
    report.metric("floater_share", round(counts["floaters"] / max(start, 1), 5))
    report.metric("psnr_before_db", round(before, 3))
    report.metric("psnr_db", round(after, 3))
    report.metric("psnr_change_db", round(after - before, 3))
    if counts["floaters"] > 0.05 * start:
        report.warn(
            "prune-many-floaters",
            f"{counts['floaters']:,} of {start:,} splats hung in empty space near cameras. "
            "Photographs with more overlap, and a locked exposure, leave fewer.",
        )
    assert np.isfinite(splats.means).all()
    save_splats(folder, splats)
    return splats


def _one_round(
    splats: Splats,
    photographs: Sequence[Photograph],
    backend: str,
    floor_db: float,
) -> tuple[Splats, dict[str, int]]:
    """Remove what a round may, most harmful first; less of it while they lose too much."""
    import numpy as np

    from stages.measure.judge import mean_psnr_db
    from stages.measure.worth import beside_pictures, floaters, measure_worth, unneeded

    worth = measure_worth(splats, photographs, backend)
    cameras = [photograph.camera for photograph in photographs]
    floating = floaters(splats, worth, cameras)
    useless = unneeded(worth, beside_pictures(splats, cameras))
    candidates = np.flatnonzero(floating | useless)
    order = np.lexsort((candidates, worth.sse_change[candidates], ~floating[candidates]))
    chosen = candidates[order][: max(1, int(SHARE_A_ROUND * len(splats)))]
    for _ in range(BACK_OFFS):
        if not len(chosen) or len(chosen) == len(splats):
            break
        keep = np.ones(len(splats), bool)
        keep[chosen] = False
        fewer = splats.take(keep)
        if mean_psnr_db(fewer, photographs, backend) >= floor_db:
            n_floating = int(floating[chosen].sum())
            return fewer, {"floaters": n_floating, "unneeded": len(chosen) - n_floating}
        chosen = chosen[: len(chosen) // 2]
    return splats, {"floaters": 0, "unneeded": 0}


def load(folder: Path) -> Splats:
    """The pruned splats."""
    from stages.scene.storage import load_splats

    return load_splats(folder)


STAGE = Stage(
    name="prune", version=5, reads=("sfm", "train"), settings_type=PruneSettings, run=run, load=load
)
