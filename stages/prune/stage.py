"""Stage 5: removes floaters and splats that do not improve the pictures.

Training views choose what is removed and bound the loss (see `prune.rounds`). The PSNR (dB) of
the held-out views before and after is in the report, and decides nothing.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.base.atomic import replacing
from stages.base.bad_files import reading, stage_output
from stages.base.errors import ReconstructionError, SplatError
from stages.base.stage import Report
from stages.evaluate.evaluation import (
    EvaluationView,
    evaluation_subset,
    load_evaluation_views,
    mean_psnr_db,
    psnr_of_views_db,
)
from stages.evaluate.selection import FEW_VIEWS
from stages.formats.format_table import FORMATS
from stages.formats.sog_bits import choose_bits, file_size_bytes
from stages.prune.rounds import Pruner, PruningResult
from stages.prune.settings import DECIDING_VIEWS, SOG_LOSS_DB, PruneSettings
from stages.prune.summary import advise_more_splats, describe_loss, summarise
from stages.prune.targets import Targets, check_size
from stages.raster.backends import report_backend
from stages.scene import (
    PrunedSplats,
    Reconstruction,
    SizeLimit,
    Splats,
    TrainedSplats,
    evenly_spaced,
    split_held_out,
    training_extent,
)
from stages.scene.storage import load_splats, save_splats
from stages.sfm.checks.gates import STAND_STILL
from stages.train.finetune import FineTuner

_LIMIT = "limit.json"  # only where a size was requested


def run(
    inputs: Mapping[str, Any], settings: PruneSettings, folder: Path, report: Report
) -> PrunedSplats:
    """Prune inputs["train"] by the training views of inputs["sfm"]; write the rest to `folder`.

    The report gets each round, counts, and the PSNR before and after. Raises SplatError for targets
    that cannot be met, and Interrupted.
    """
    deadline = time.monotonic() + (settings.seconds or math.inf)
    trained: TrainedSplats = inputs["train"]
    if trained.contradicted and not settings.allow_partial:
        raise _contradicted()
    reconstruction: Reconstruction = inputs["sfm"].with_cameras(trained.cameras)
    reconstruction = reconstruction.with_masks(trained.masks)
    splats, backend = trained.splats, settings.backend
    _check_one_splat(settings, splats, reconstruction)
    chosen, held_out = split_held_out(reconstruction.views)
    training, evaluated = (
        load_evaluation_views(
            reconstruction.folder, views, splats.draw_settings, report.stop_requested
        )
        for views in (chosen, [held_out[i] for i in evaluation_subset(len(held_out))])
    )
    before_db = psnr_of_views_db(splats, evaluated, backend)
    if np.isnan(before_db).all():  # no view is held out, or no pixel of one counts
        evaluated = training
        before_db = psnr_of_views_db(splats, evaluated, backend)
    pruner = pruner_of(settings, reconstruction, trained, training, backend, report, deadline)
    found = pruner.prune(splats)
    loss_db = before_db - psnr_of_views_db(found.splats, evaluated, backend)
    before_db, loss_db = (db[~np.isnan(before_db)] for db in (before_db, loss_db))
    report_backend(report, backend)
    report.metric("evaluated_side_px", splats.draw_settings.side)
    mean_db, lost_db = float(before_db.mean()), float(loss_db.mean())
    report.metric("psnr_before_db", round(mean_db, 3))
    report.metric("psnr_db", round(mean_db - lost_db, 3))
    report.metric("psnr_change_db", round(-lost_db, 3))
    report.metric("psnr_change_worst_view_db", round(-float(loss_db.max()), 3))
    report.metric("finetune_steps", pruner.finetuner.steps)
    _report_result(splats, found, report)
    report.metric("summary", summarise(trained, found, settings.strength, pruner.finetuner.steps))
    requested = found.forced or settings.min_psnr > 0
    if pruner.targets.broken_by(loss_db) and not requested:
        report.warn("prune-loss-above-limit", describe_loss(loss_db, pruner.targets))
    # of fewer views no splat is seen by enough to be removed, however many there are
    enough = len(training) >= FEW_VIEWS
    if enough and (advice := advise_more_splats(found, settings.strength)):
        report.warn("prune-more-would-pay", advice)
    assert np.isfinite(found.splats.means).all()
    return _saved(folder, found.splats, settings)


def _contradicted() -> SplatError:
    return ReconstructionError(
        "prune-contradictions",
        given="The matches of several pairs of photographs contradict the cameras found, and "
        "photographs that took no part in training are not reproduced.",
        wanted="A scene that stands still, and cameras in their places.",
        hint=f"{STAND_STILL} Look at the result with `splat view`. If it is right all the same, "
        "`splat prune --allow-partial` goes on with it.",
    )


def pruner_of(
    settings: PruneSettings,
    reconstruction: Reconstruction,
    trained: TrainedSplats,
    training: Sequence[EvaluationView],
    backend: str,
    report: Report,
    deadline: float = math.inf,
) -> Pruner:
    """What prunes the splats of `trained`.

    Args:
        settings: of the stage.
        reconstruction: with the cameras that training refined.
        trained: what was trained.
        training: the training views.
        backend: name of the rasteriser.
        report: for progress.
        deadline: after which no round begins, as `time.monotonic`.
    """
    extent = training_extent(reconstruction)
    finetuner = FineTuner(training, extent, backend, report, trained.dropout)
    size_bytes = _size_measure(settings, trained.splats, training, reconstruction)
    targets = Targets(
        strength=settings.strength,
        max_loss_db=settings.max_loss_db,
        max_splats=settings.max_splats,
        max_bytes=settings.max_mb * 1e6,
        min_psnr_db=settings.min_psnr,
        size_bytes=size_bytes,
        least_bytes=size_bytes(trained.splats.take(slice(1))) if settings.max_mb else 0,
    )
    limits = settings.rounds, settings.finetune_steps
    return Pruner(training, targets, backend, finetuner, *limits, report, deadline)


def _size_measure(
    settings: PruneSettings,
    splats: Splats,
    training: Sequence[EvaluationView],
    reconstruction: Reconstruction,
) -> Callable[[Splats], int]:
    """Gives the size of the file that --max-mb is about. A .sog is written with the bit depths that
    `quantise` chooses for all splats: they hardly depend on how many are left."""
    row = FORMATS[settings.mb_of]
    depths: dict[str, int] = {}
    if settings.max_mb and row.has_bit_depths:
        views, backend = evenly_spaced(training, DECIDING_VIEWS), settings.backend
        depths, _ = choose_bits(splats, lambda s: mean_psnr_db(s, views, backend), SOG_LOSS_DB)
    return lambda s: file_size_bytes(row, s, depths, reconstruction.units, reconstruction.views)


def _check_one_splat(
    settings: PruneSettings, splats: Splats, reconstruction: Reconstruction
) -> None:
    """Raise SplatError (prune-too-small) where --max-mb is less than a file of one splat takes."""
    one, row = splats.take(slice(1)), FORMATS[settings.mb_of]
    if settings.max_mb:
        size = file_size_bytes(row, one, {}, reconstruction.units, reconstruction.views)
        check_size(settings.max_mb * 1e6, size, len(one))


def _report_result(before: Splats, found: PruningResult, report: Report) -> None:
    """Counts, the rate-distortion cost and the rounds as metrics; a warning for many floaters."""
    floaters = sum(one.floaters for one in found.rounds if one.kept)
    start, after, cost = len(before), found.splats, found.rate_distortion
    degrees = [int((after.sh_degrees == d).sum()) for d in range(after.sh_degree + 1)]
    report.metric("splats_before", start)
    report.metric("splats", len(after))
    report.metric("floaters_removed", floaters)
    report.metric("unneeded_removed", start - len(after) - floaters)
    report.metric("splats_by_sh_degree", degrees)
    cost_figures = asdict(cost) | {"bits_per_parameter": cost.bits_per_parameter}
    report.metric("rate_distortion", cost_figures)
    report.metric("training_psnr_db", round(found.end_db, 3))
    report.metric("stopped_by", found.stopped_by)
    report.metric("rounds", [asdict(one) for one in found.rounds])
    if floaters > 0.05 * start:
        report.warn(
            "prune-many-floaters",
            f"{floaters:,} of {start:,} splats were floaters in free space near cameras. "
            "Photographs with more overlap, and a locked exposure, leave fewer.",
        )


def _saved(folder: Path, splats: Splats, settings: PruneSettings) -> PrunedSplats:
    """What `load` reads."""
    save_splats(folder, splats)
    if not settings.max_mb:
        return PrunedSplats(splats)
    limit = SizeLimit(settings.mb_of, settings.max_mb * 1e6)
    with replacing(folder / _LIMIT) as temporary:
        temporary.write_text(json.dumps(asdict(limit)) + "\n", encoding="utf-8")
    return PrunedSplats(splats, limit)


def load(folder: Path) -> PrunedSplats:
    """The result of a finished folder. Raises SplatError if it is damaged."""
    splats, path = load_splats(folder), folder / _LIMIT
    if not path.exists():
        return PrunedSplats(splats)
    with reading(path, stage_output("prune-folder-damaged")):
        limit = json.loads(path.read_text(encoding="utf-8"))
        return PrunedSplats(splats, SizeLimit(str(limit["format"]), float(limit["max_bytes"])))
