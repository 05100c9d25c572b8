"""Stage 4: Splats -> TrainedSplats: optimises splats so that renders match the training views.

Follows Kerbl et al. 2023 (see `train.trainer` and `train.schedule`). Splats are split and
removed on the way (`train.hooks`). Held-out views are evaluated and decide nothing.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.bad_files import reading, stage_output
from stages.base.errors import QualityError, ResourceError, SplatError
from stages.base.settings import setting
from stages.base.stage import Report, Stage
from stages.formats.output_formats import drawing_setting
from stages.formats.table import PLAIN
from stages.raster.backends import (
    backend_setting,
    device_setting,
    report_backend,
    unavailable_backends,
)

if TYPE_CHECKING:
    from stages.raster.definition import MemoryFull
    from stages.scene import Reconstruction, Splats, TrainedSplats
    from stages.train.trainer import Trainer


@dataclass(frozen=True)
class TrainSettings:
    steps: int = setting(
        7000,
        "Training steps, with one photograph each.",
        panel="Quality and time",
        min=1,
        max=1_000_000,
    )
    steps_per_view: int = setting(
        800,
        "Training steps for each training view, at most: more fit these views alone. 0: no limit.",
        panel="Advanced",
        min=0,
        max=1_000_000,
    )
    train_side: int = setting(
        800,
        "Longer side of the photographs in training (pixels).",
        panel="Quality and time",
        min=16,
        max=8192,
    )
    sh_degree: int = setting(2, "Degree of view-dependent colour, 0 (none) to 3.", min=0, max=3)
    max_splats: int = setting(
        0,
        "Largest number of splats; those that photographs can spare are removed later. 0: what "
        "free memory allows, with no more parameters than the photographs have pixel values.",
        panel="Size",
        min=0,
        max=100_000_000,
    )
    seconds: float = setting(
        0.0,
        "Time limit in seconds, of the whole command: training makes as many steps as "
        "fit, whatever --steps says, and pruning as many rounds. 0: no limit.",
        panel="Quality and time",
        min=0,
        max=1e7,
    )
    smooth: bool = setting(
        False,
        "Train under a 3D smoothing filter, so that no detail is finer than the "
        "photographs show: softer from close by, without needles and specks.",
    )
    seed: int = setting(0, "Seed of all random numbers.", min=0, max=2**31 - 1)
    background: str = setting(
        "black",
        "Background in training: black, as in viewers, or any, a random colour at "
        "each step, for scenes that are drawn over others. Cut-out objects always use any.",
        panel="Light and masks",
        choices=("black", "any"),
    )
    light: str = setting(
        "auto",
        "Bring all photographs to the median exposure and white balance before "
        "training: auto (if they differ by more than a camera's noise and points agree), on or "
        "off. Vignetting that points agree about is corrected unless this is off.",
        panel="Light and masks",
        choices=("auto", "on", "off"),
    )
    refine_in_training: bool = setting(
        False,
        "Let training move the cameras of its photographs, and one focal length factor for all: "
        "for known cameras that are only nearly right.",
        panel="Known cameras",
    )
    drawing: str = drawing_setting()
    blocks: str = setting(
        "1",
        "Divide the scene into this many blocks, train each on the photographs that "
        "show it, and merge them; auto: one block for about every 250 photographs.",
        panel="Advanced",
        pattern=r"auto|[1-9]\d{0,3}",
        wanted="A whole number of blocks, or auto.",
    )
    within: tuple[float, ...] = setting(
        (),
        "Densify only inside this rectangle of the ground plane (world units); the "
        "rest stays as coarse as it is.",
        together="X0 Z0 X1 Z1",
        min=-1e30,
        max=1e30,
    )
    backend: str = backend_setting()
    device: str = device_setting()

    @property
    def antialias(self) -> bool:
        """Whether splats are trained to be drawn with opacity compensation."""
        return self.drawing != PLAIN


_TRAINED = "training.json"
PRESETS: dict[str, TrainSettings] = {
    "preview": TrainSettings(steps=2000, train_side=480, sh_degree=1, max_splats=60_000),
    "standard": TrainSettings(steps=7000, train_side=800, sh_degree=2, max_splats=250_000),
    "best": TrainSettings(steps=30_000, train_side=1600, sh_degree=3),
}


def run(
    inputs: Mapping[str, Any], settings: TrainSettings, folder: Path, report: Report
) -> TrainedSplats:
    """Train; write splats.bin, training.json, history.csv, a plot, and renders of held-out views.

    Raises Interrupted, and SplatError: raster-gpu-memory, train-nothing-left.
    """
    from stages.raster.definition import MemoryFull
    from stages.raster.smoothing import smoothed
    from stages.scene import TrainedSplats
    from stages.train.build import make_trainer
    from stages.train.cap import lower_cap, remove_cap
    from stages.train.checkpoint import remove_checkpoint
    from stages.train.conversion import splats_of
    from stages.train.quality import write_history, write_quality

    if settings.blocks != "1":
        raise ValueError("blocks are runs of their own: stages.distributed.blocks trains them")
    started = time.monotonic()
    reconstruction: Reconstruction = inputs["sfm"]
    start: Splats = inputs["seed"]
    trainer = make_trainer(reconstruction, len(start), settings, folder, report)
    report_backend(report, trainer.backend)
    report.metric("device", report.device)
    report.metric("unavailable_backends", unavailable_backends(settings.backend))
    report.metric("training_views", len(trainer.train))
    report.metric("held_out_views", len(trainer.held_out))
    try:
        model = trainer.run(start)
    except MemoryFull as full:
        raise _does_not_fit(full, lower_cap(folder, full.fits).splats) from full
    splats = splats_of(model, settings.sh_degree, start, trainer.draw_settings)
    if settings.smooth:
        splats = smoothed(splats, trainer.smoothing_widths(splats.means))
    if len(splats) == 0:
        raise _nothing_left()
    refined = None
    if trainer.refinement is not None:
        trainer.register_held_out()
        refined = trainer.refinement.result
        reconstruction = reconstruction.with_cameras(refined)
    views, draw_settings = trainer.held_out, trainer.draw_settings
    write_quality(trainer.render, views, draw_settings, reconstruction, folder, report)
    write_history(trainer.history, trainer.times, folder, report)
    trained = TrainedSplats(splats, trainer.dropout, refined)
    save(folder, trained)
    remove_checkpoint(folder)
    remove_cap(folder)
    report.metric("splats", len(splats))
    _report_course(trainer, report)
    _report_cap(trainer, report)
    report.metric("train_seconds", round(time.monotonic() - started, 1))
    return trained


def _report_course(trainer: Trainer, report: Report) -> None:
    """How many steps were made, and by which backends."""
    report.metric("steps", trainer.schedule.steps)
    report.metric("steps_skipped", int(trainer.stepper.skipped))
    report.metric("dropout", trainer.dropout)
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
        report.metric("trained_by", ", then ".join(parts))
        report.warn(
            "train-several-backends",
            f"Trained by {report.metrics['trained_by']}: neither backend alone gives these bytes.",
        )


def _report_cap(trainer: Trainer, report: Report) -> None:
    """Whether the cap of splats was lowered or reached."""
    from stages.train.cap import DEVICE_MEMORY, PHOTOGRAPHS

    if trainer.cap < report.metrics["splat_cap"]:
        report.metric("splat_cap", trainer.cap)
        report.metric("splat_cap_from", DEVICE_MEMORY)
    origin = report.metrics["splat_cap_from"]
    if origin == DEVICE_MEMORY:
        report.warn(
            "train-gpu-memory",
            f"The GPU's memory was full: trained with at most {trainer.cap:,} splats.",
        )
    densified = max(entry["splats"] for entry in trainer.history)
    report.metric("densified_splats", densified)
    if densified < 0.98 * trainer.cap:
        return
    more = "more memory, or a higher --max-splats, may add detail"
    if origin == PHOTOGRAPHS:
        more = (
            "they have as many parameters as the photographs have pixel values; more or larger "
            "photographs may add detail"
        )
    report.warn(
        "train-splat-cap-reached",
        f"Densification stopped at the cap of {trainer.cap:,} splats, of which the photographs "
        f"need {report.metrics['splats']:,}; {more}.",
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
    from stages.base.atomic import replacing
    from stages.scene.storage import save_splats

    save_splats(folder, trained.splats)
    facts: dict[str, Any] = {"dropout": trained.dropout}
    if trained.cameras is not None:
        poses = {name: pose.tolist() for name, pose in trained.cameras.poses.items()}
        facts["cameras"] = {"poses": poses, "focal_factor": trained.cameras.focal_factor}
    with replacing(folder / _TRAINED) as temporary:
        temporary.write_text(json.dumps(facts) + "\n", encoding="utf-8")


def load(folder: Path) -> TrainedSplats:
    """The result of a finished folder. Raises SplatError if it is damaged."""
    import numpy as np

    from stages.scene import RefinedCameras, TrainedSplats
    from stages.scene.storage import load_splats

    splats, cameras = load_splats(folder), None
    with reading(folder / _TRAINED, stage_output("train-folder-damaged")):
        facts = json.loads((folder / _TRAINED).read_text(encoding="utf-8"))
        if found := facts.get("cameras"):
            poses = {name: np.array(pose, np.float64) for name, pose in found["poses"].items()}
            cameras = RefinedCameras(poses, float(found["focal_factor"]))
        return TrainedSplats(splats, bool(facts["dropout"]), cameras)


STAGE = Stage(
    name="train", version=30, reads=("sfm", "seed"), settings_type=TrainSettings, run=run, load=load
)
