"""Stage 4: Splats -> TrainedSplats: optimises splats so that renders match the training views.

Follows Kerbl et al. 2023 (see `train.trainer` and `train.schedule`). Splats are split and
removed on the way (`train.hooks`). Held-out views are evaluated and decide nothing.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.base.atomic import replacing
from stages.base.bad_files import reading, stage_output
from stages.base.errors import QualityError, ResourceError, SplatError
from stages.base.memory import MIB, training_mib
from stages.base.stage import Report
from stages.base.text import counted, size
from stages.evaluate.verdict import WRONG
from stages.raster.backends import report_backend, unavailable_backends
from stages.raster.definition import MemoryFull
from stages.raster.smoothing import smoothed
from stages.scene import Reconstruction, RefinedCameras, Splats, TrainedSplats
from stages.scene.storage import load_splats, save_splats
from stages.train import transients
from stages.train.build import make_trainer
from stages.train.cap import (
    DEVICE_MEMORY,
    FREE_MEMORY,
    Cap,
    lower_cap,
    remove_cap,
)
from stages.train.charts import transients_sheet
from stages.train.checkpoint import remove_checkpoint
from stages.train.conversion import splats_of
from stages.train.loop import train
from stages.train.quality import report_verdict, write_history, write_quality
from stages.train.settings import PRESETS, TrainSettings
from stages.train.trainer import Trainer, TrainingTask

_TRAINED = "training.json"
_FEW_STEPS = 500  # with a time limit
_AT_THE_CAP = 0.98  # of it: the last round of densification seldom fills it


def run(
    inputs: Mapping[str, Any], settings: TrainSettings, folder: Path, report: Report
) -> TrainedSplats:
    """Train; write splats.bin, training.json, history.csv, a plot, and renders of held-out views.

    Raises Interrupted, and SplatError: raster-gpu-memory, train-nothing-left.
    """
    if settings.blocks != "1":
        raise ValueError("blocks are runs of their own: stages.distributed.blocks trains them")
    reconstruction: Reconstruction = inputs["sfm"]
    start: Splats = inputs["seed"]
    trainer = make_trainer(reconstruction, start, settings, folder, report)
    task = trainer.task
    _report_task(task, settings, report)
    try:
        model = train(trainer, start)
    except MemoryFull as full:
        raise _does_not_fit(full, lower_cap(folder, full.fits).splats) from full
    splats = splats_of(model, trainer.schedule.sh_degree, start, task.draw_settings)
    if settings.smooth:
        splats = smoothed(splats, trainer.smoothing_widths(splats.means))
    if len(splats) == 0:
        raise _nothing_left()
    refined, held_out = None, task.held_out
    if trainer.refinement is not None:
        held_out, refined = trainer.registered_held_out(), trainer.refinement.result
        reconstruction = reconstruction.with_cameras(refined)
    masks = _save_masks(trainer, folder, report)
    reconstruction = reconstruction.with_masks(masks)
    write_quality(trainer.render, held_out, task.draw_settings, reconstruction, folder, report)
    write_history(trainer.history, folder, report)
    found = report_verdict(splats, held_out, reconstruction, task.backend, report)
    contradicted = found.grade == WRONG and reconstruction.contradicted
    steps = trainer.schedule.steps
    trained = TrainedSplats(splats, task.dropout, refined, contradicted, masks, steps)
    save(folder, trained)
    remove_checkpoint(folder)
    remove_cap(folder)
    report.metric("splats", len(splats))
    _report_course(trainer, report)
    if settings.seconds and 0 < trainer.schedule.steps < _FEW_STEPS:
        report.warn(
            "train-few-steps",
            f"The time limit left {trainer.schedule.steps:,} steps for training; --preset preview "
            f"makes {PRESETS['preview'].steps:,}. More --seconds, or a smaller --train-side, give "
            "better splats.",
        )
    _report_cap(trainer.cap, trainer.history.most_splats, report)
    return trained


def _save_masks(trainer: Trainer, folder: Path, report: Report) -> dict[str, Path]:
    """Write what the photographs show of what moved, and report it; the masks by photograph."""
    shares = [float(parts.mean()) for parts in trainer.transient]
    report.metric("transient_share", round(float(np.mean(shares or [0.0])), 4))
    shutil.rmtree(folder / transients.FOLDER, ignore_errors=True)
    if not any(shares):
        return {}
    rows = range(len(shares))
    names = [view.name for view in trainer.task.views]
    masks = transients.save_masks(folder, names, map(trainer.level, rows), trainer.transient)
    most = sorted(rows, key=lambda row: -shares[row])[: transients.SHOWN]
    photographs = [(names[row], trainer.level(row)) for row in most if names[row] in masks]
    transients_sheet(folder / "transients.png", photographs)
    report.warn(
        "train-transients",
        f"Something moved in {counted(len(masks), 'photograph')}: training ignored the parts that "
        "other photographs do not confirm, see transients.png.",
    )
    return masks


def _report_task(task: TrainingTask, settings: TrainSettings, report: Report) -> None:
    report_backend(report, task.backend)
    report.metric("device", report.device)
    report.metric("unavailable_backends", unavailable_backends(settings.backend))
    report.metric("training_views", len(task.views))
    cameras = (view.levels[-1].camera for view in task.views)
    report.metric("side_px", max(max(camera.width, camera.height) for camera in cameras))
    report.metric("held_out_views", len(task.held_out))


def _report_course(trainer: Trainer, report: Report) -> None:
    """How many steps were made, and by which backends."""
    report.metric("steps", trainer.schedule.steps)
    report.metric("steps_skipped", int(trainer.stepper.skipped))
    report.metric("dropout", trainer.task.dropout)
    if trainer.refinement is not None:
        moved, turned_deg = trainer.refinement.changes
        report.metric("cameras_moved", moved)
        report.metric("cameras_turned_deg", turned_deg)
        report.metric("focal_factor", round(trainer.refinement.focal_factor, 6))
    entries = trainer.provenance
    report.metric("provenance", [asdict(entry) for entry in entries])
    if len(entries) > 1:
        ends = [f" to step {entry.step:,}" for entry in entries[1:]] + [""]
        parts = (f"{e.backend} ({e.device}){end}" for e, end in zip(entries, ends, strict=True))
        trained_by = ", then ".join(parts)
        report.metric("trained_by", trained_by)
        report.warn(
            "train-several-backends",
            f"Trained by {trained_by}: neither backend alone gives these bytes.",
        )


def _report_cap(cap: Cap, densified: int, report: Report) -> None:
    """The cap of splats; a warning where memory lowered it, not where the user or a preset chose
    it. densified: the largest number of splats in the run."""
    report.metric("splat_cap", cap.splats)
    report.metric("splat_cap_from", cap.origin)
    report.metric("densified_splats", densified)
    if cap.origin == DEVICE_MEMORY:
        report.warn(
            "train-gpu-memory",
            f"The GPU's memory was full: trained with at most {cap.splats:,} splats.",
        )
    if cap.origin == FREE_MEMORY and densified >= _AT_THE_CAP * cap.splats:
        report.warn(
            "train-splat-cap-reached",
            f"Free memory ({size((cap.free_mib or 0) * MIB)}) limited training to {cap.splats:,} "
            f"splats; 100,000 more take {size(training_mib(100_000) * MIB)}.",
        )


def _does_not_fit(full: MemoryFull, cap: int) -> SplatError:
    return ResourceError(
        full.code,
        given=full.given,
        wanted=full.wanted,
        hint=f"Run the same command again to resume from the last checkpoint with at most {cap:,} "
        f"splats. --max-splats {cap} starts again; so does a larger --max-splats, once other "
        "programs that use the GPU are closed.",
    )


def _nothing_left() -> SplatError:
    return QualityError(
        "train-nothing-left",
        given="Every splat became transparent or invalid in training.",
        wanted="A scene that the photographs agree on.",
        hint="Check the reconstruction with `splat status`; retake blurred photographs, or try "
        "another --seed.",
    )


def save(folder: Path, trained: TrainedSplats) -> None:
    """What `load` reads. Raises SplatError."""
    save_splats(folder, trained.splats)
    names = "dropout", "contradicted", "steps"
    facts: dict[str, Any] = {name: getattr(trained, name) for name in names}
    facts["masks"] = {
        name: path.relative_to(folder).as_posix() for name, path in trained.masks.items()
    }
    if trained.cameras is not None:
        poses = {name: pose.tolist() for name, pose in trained.cameras.poses.items()}
        facts["cameras"] = {"poses": poses, "focal_factor": trained.cameras.focal_factor}
    with replacing(folder / _TRAINED) as temporary:
        temporary.write_text(json.dumps(facts) + "\n", encoding="utf-8")


def load(folder: Path) -> TrainedSplats:
    """The result of a finished folder. Raises SplatError if it is damaged."""
    splats, cameras = load_splats(folder), None
    with reading(folder / _TRAINED, stage_output("train-folder-damaged")):
        facts = json.loads((folder / _TRAINED).read_text(encoding="utf-8"))
        if found := facts.get("cameras"):
            poses = {name: np.array(pose, np.float64) for name, pose in found["poses"].items()}
            cameras = RefinedCameras(poses, float(found["focal_factor"]))
        contradicted = bool(facts.get("contradicted"))
        masks = {name: folder / path for name, path in facts.get("masks", {}).items()}
        dropout, steps = bool(facts["dropout"]), int(facts.get("steps", 0))
        return TrainedSplats(splats, dropout, cameras, contradicted, masks, steps)
