"""Stage 5: model only what the scene requires: what no photograph needs goes, and what does not pay
its way; the rest goes on learning a little. Prove that it cost nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.stage import Report, Stage
from stages.capacity.usual import DECIDING, SOG_LOSS_DB
from stages.formats.table import FORMATS
from stages.raster.backends import (
    backend_of_settings,
    backend_setting,
    device_setting,
    report_backend,
)

if TYPE_CHECKING:
    from stages.capacity.pruning import PruningResult
    from stages.measure.evaluation import EvaluationView
    from stages.scene import Reconstruction, Splats, TrainedSplats


@dataclass(frozen=True)
class PruneSettings:
    rounds: int = field(
        default=8,
        metadata={
            "help": "Rounds of pruning, each of a tenth of the splats at most; 0 for none.",
            "min": 0,
            "max": 100,
        },
    )
    price: float = field(
        default=1.0,
        metadata={
            "panel": "Size",
            "help": "How much a splat must be worth to stay, 1 for what the photographs ask; the "
            "loss allowed grows with it.",
            "min": 0.001,
            "max": 1000,
        },
    )
    max_loss_db: float = field(
        default=0.1,
        metadata={
            "help": "PSNR that pruning may cost views that were not trained on, as far as training "
            "can tell, at price 1 (dB).",
            "min": 0,
            "max": 100,
        },
    )
    max_splats: int = field(
        default=0,
        metadata={"help": "Splats at most, whatever it costs.", "min": 0, "max": 100_000_000},
    )
    max_mb: float = field(
        default=0.0,
        metadata={
            "panel": "Size",
            "help": "Size at most, whatever it costs, of the file that --mb-of names; 0 for any "
            "(megabytes).",
            "min": 0,
            "max": 1_000_000,
        },
    )
    mb_of: str = field(
        default="ply",
        metadata={
            "panel": "Size",
            "help": "Format that --max-mb speaks of",
            "choices": tuple(FORMATS),
        },
    )
    min_psnr: float = field(
        default=0.0,
        metadata={
            "panel": "Size",
            "help": "As small as the training photographs allow at this PSNR, instead of by price; "
            "0 for none (dB).",
            "min": 0,
            "max": 99,
        },
    )
    finetune_steps: int = field(
        default=90,
        metadata={
            "panel": "Advanced",
            "help": "Steps of fine-tuning after each round; 0 for none.",
            "min": 0,
            "max": 100_000,
        },
    )
    backend: str = backend_setting()
    device: str = device_setting()


def run(inputs: Mapping[str, Any], settings: PruneSettings, folder: Path, report: Report) -> Splats:
    """Fewer splats, written to `folder`; each round, counts and PSNR before and after into the
    report. Raises SplatError for targets that cannot be met."""
    import numpy as np

    from stages.capacity import summary
    from stages.capacity.pruning import Pruner
    from stages.capacity.targets import Targets, felt_share
    from stages.measure.evaluation import load_evaluation_views, mean_psnr_db
    from stages.scene import split_held_out, training_extent
    from stages.scene.storage import save_splats
    from stages.training.finetune import FineTuner

    reconstruction: Reconstruction = inputs["sfm"]
    trained: TrainedSplats = inputs["train"]
    splats = trained.splats
    kept, held = split_held_out(reconstruction.views)
    photographs = load_evaluation_views(reconstruction.folder, kept, splats.draw_settings)
    judges = load_evaluation_views(reconstruction.folder, held, splats.draw_settings) or photographs
    backend = backend_of_settings(settings)
    before = mean_psnr_db(splats, judges, backend)
    extent = training_extent(reconstruction)
    tuner = FineTuner(photographs, extent, backend, report, trained.dropout)
    size_bytes = _sizes(settings, splats, photographs, reconstruction)
    targets = Targets(
        settings.price,
        settings.max_loss_db,
        felt_share(trained.overfitted),
        settings.max_splats,
        settings.max_mb * 1e6,
        settings.min_psnr,
        size_bytes,
    )
    shrinking = Pruner(
        *(photographs, targets, backend, tuner, settings.rounds, settings.finetune_steps, report)
    )
    found = shrinking.run(splats)
    after = mean_psnr_db(found.splats, judges, backend)
    report_backend(report, backend)
    report.metric("judged_side_px", splats.draw_settings.side)
    report.metric("psnr_before_db", round(before, 3))
    report.metric("psnr_db", round(after, 3))
    report.metric("psnr_change_db", round(after - before, 3))
    report.metric("tune_steps", tuner.steps)
    _report_cuts(splats, found, report)
    report.metric("said", summary.summarise(trained, found, settings.price, tuner.steps))
    if more := summary.more_would_pay(found, settings.price):
        report.warn("prune-more-would-pay", more)
    assert np.isfinite(found.splats.means).all()
    save_splats(folder, found.splats)
    return found.splats


def _sizes(
    settings: PruneSettings,
    splats: Splats,
    photographs: Sequence[EvaluationView],
    reconstruction: Reconstruction,
) -> Callable[[Splats], int]:
    """Measures the file that --max-mb speaks of, as one that is really written: in as few bits as
    quantise will choose, which hardly depends on how many splats are left."""
    import tempfile

    from stages import formats
    from stages.base.lazy import load_object
    from stages.capacity.bits import choose_bits
    from stages.formats.quantisation import BitDepths
    from stages.measure.evaluation import mean_psnr_db
    from stages.scene import evenly_spaced

    row = FORMATS[settings.mb_of]
    few: dict[str, int] = {}
    if settings.max_mb and row.quantiser:
        deciding, backend = evenly_spaced(photographs, DECIDING), backend_of_settings(settings)
        few, _ = choose_bits(splats, lambda s: mean_psnr_db(s, deciding, backend), SOG_LOSS_DB)

    def size_bytes(splats: Splats) -> int:
        held = load_object(row.quantiser)(splats, BitDepths(**few)) if few else splats
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"scene.{settings.mb_of}"
            formats.write(path, held, units=reconstruction.units, views=reconstruction.views)
            return row.size_bytes(path)

    return size_bytes


def _report_cuts(before: Splats, found: PruningResult, report: Report) -> None:
    """Counts, the price and the rounds as metrics; a warning where much was in the air."""
    kept = [one for one in found.rounds if one.kept]
    floaters, start = sum(one.floaters for one in kept), len(before)
    after = found.splats
    degrees = [int((after.sh_degrees == d).sum()) for d in range(after.sh_degree + 1)]
    report.metric("splats_before", start)
    report.metric("splats", len(after))
    report.metric("floaters_removed", floaters)
    report.metric("unneeded_removed", start - len(after) - floaters)
    report.metric("floater_share", round(floaters / max(start, 1), 5))
    report.metric("splats_by_sh_degree", degrees)
    report.metric(
        "price", asdict(found.price) | {"bits_per_parameter": found.price.bits_per_parameter}
    )
    report.metric("training_psnr_before_db", round(found.start_db, 3))
    report.metric("training_psnr_db", round(found.end_db, 3))
    report.metric("stopped_by", found.stopped_by)
    report.metric("rounds", [asdict(one) for one in found.rounds])
    if floaters > 0.05 * start:
        report.warn(
            "prune-many-floaters",
            f"{floaters:,} of {start:,} splats hung in empty space near cameras. "
            "Photographs with more overlap, and a locked exposure, leave fewer.",
        )


def load(folder: Path) -> Splats:
    """The pruned splats."""
    from stages.scene.storage import load_splats

    return load_splats(folder)


STAGE = Stage(
    name="prune",
    version=10,
    reads=("sfm", "train"),
    settings_type=PruneSettings,
    run=run,
    load=load,
)
