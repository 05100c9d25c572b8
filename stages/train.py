"""Stage 4: fit splats to the photographs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from stages.base.errors import Family, SplatError
from stages.base.stage import Report, Stage
from stages.base.text import counted
from stages.raster.backends import (
    backend_of_settings,
    backend_setting,
    device_setting,
    report_backend,
    unavailable_backends,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stages.measure.evaluation import EvaluationView
    from stages.raster.definition import MemoryFull
    from stages.scene import Camera, DrawSettings, Reconstruction, Splats, TrainedSplats
    from stages.training.clock import Elapsed
    from stages.training.optimiser import Model
    from stages.training.trainer import Trainer


@dataclass(frozen=True)
class TrainSettings:
    steps: int = field(
        default=7000,
        metadata={
            "panel": "Quality and time",
            "help": "Steps of training, one photograph each.",
            "min": 1,
            "max": 1_000_000,
        },
    )
    train_side: int = field(
        default=800,
        metadata={
            "panel": "Quality and time",
            "help": "Longer side of the photographs in training (pixels).",
            "min": 16,
            "max": 8192,
        },
    )
    sh_degree: int = field(
        default=2,
        metadata={"help": "Degree of view-dependent colour, 0 (none) to 3.", "min": 0, "max": 3},
    )
    max_splats: int = field(
        default=0,
        metadata={
            "panel": "Size",
            "help": "Splats at most; 0: what free memory allows, and no more numbers than the "
            "photographs have.",
            "min": 0,
            "max": 100_000_000,
        },
    )
    seconds: float = field(
        default=0.0,
        metadata={
            "panel": "Quality and time",
            "help": "Seconds that training may take: as many steps as fit, whatever --steps says. "
            "0: as long as the steps take.",
            "min": 0,
            "max": 1e7,
        },
    )
    patience: float = field(
        default=0.0,
        metadata={
            "panel": "Advanced",
            "help": "Stop densifying when it no longer improves any validation view by this "
            "many dB. 0: never.",
            "min": 0,
            "max": 10,
        },
    )
    smooth: bool = field(
        default=False,
        metadata={
            "help": "Allow no detail finer than a photograph shows: softer from close by, without "
            "needles and dust."
        },
    )
    seed: int = field(
        default=0, metadata={"help": "Seed of all random numbers.", "min": 0, "max": 2**31 - 1}
    )
    background: str = field(
        default="black",
        metadata={
            "panel": "Light and masks",
            "help": "What is behind photographs in training: black, which viewers have too, or any "
            "colour, for scenes that will be laid over others. Objects cut out always take any.",
            "choices": ("black", "any"),
        },
    )
    light: str = field(
        default="auto",
        metadata={
            "panel": "Light and masks",
            "help": "Bring photographs to the exposure and white balance of the median one first: "
            "auto (where they differ by more than a camera's noise), on or off.",
            "choices": ("auto", "on", "off"),
        },
    )
    blocks: str = field(
        default="1",
        metadata={
            "panel": "Advanced",
            "help": "Cut the scene into as many blocks, train each on the photographs that show "
            "it, and make them one again; auto: one for about every 250 photographs.",
            "pattern": r"auto|[1-9]\d{0,3}",
            "wanted": "A whole number of blocks, or auto.",
        },
    )
    within: tuple[float, ...] = field(
        default=(),
        metadata={
            "help": "Grow only in this rectangle of the ground plane (world units); what is "
            "outside stays as coarse as it is.",
            "together": "X0 Z0 X1 Z1",
            "min": -1e30,
            "max": 1e30,
        },
    )
    backend: str = backend_setting()
    device: str = device_setting()


_LEARNT = "learnt.json"
PRESETS: dict[str, TrainSettings] = {
    "preview": TrainSettings(steps=3000, train_side=480, sh_degree=1, max_splats=60_000),
    "standard": TrainSettings(steps=7000, train_side=800, sh_degree=2, max_splats=250_000),
    "best": TrainSettings(steps=30_000, train_side=1600, sh_degree=3),
}


def run(
    inputs: Mapping[str, Any], settings: TrainSettings, folder: Path, report: Report
) -> TrainedSplats:
    """Train; write splats.bin, history.csv, a plot, and held-out photographs as a contact sheet
    with a legend."""
    from stages.raster.definition import MemoryFull
    from stages.raster.smoothing import smoothed
    from stages.scene import TrainedSplats
    from stages.training.cap import lower_cap, remove_cap
    from stages.training.checkpoint import remove_checkpoint

    if settings.blocks != "1":
        raise ValueError("blocks are runs of their own: stages.distributed.blocks trains them")
    started = time.monotonic()
    reconstruction: Reconstruction = inputs["sfm"]
    start: Splats = inputs["seed"]
    trainer = make_trainer(reconstruction, len(start), settings, folder, report)
    if settings.seconds:
        trainer.seconds = max(settings.seconds - (time.monotonic() - started), 1.0)
    report_backend(report, trainer.backend)
    report.metric("device", report.device)
    report.metric("unavailable_backends", unavailable_backends(settings.backend))
    report.metric("train_photographs", len(trainer.train))
    report.metric("held_out_photographs", len(trainer.held_out))
    try:
        model = trainer.run(start)
    except MemoryFull as full:
        raise _does_not_fit(full, lower_cap(folder, full.fits).splats) from full
    splats = finished(model, settings.sh_degree, start, trainer.draw_settings)
    if settings.smooth:
        splats = smoothed(splats, trainer.widths(splats.means))
    if len(splats) == 0:
        raise _nothing_left()
    write_quality(trainer, reconstruction, folder, report)
    trained = TrainedSplats(splats, trainer.dropout, overfitted=trainer.dropout)
    save(folder, trained)
    remove_checkpoint(folder)
    remove_cap(folder)
    report.metric("steps", trainer.schedule.steps)
    _report_makers(trainer, report)
    report.metric("validation_views", len(trainer.validation))
    report.metric("overfitted", trainer.dropout)
    if trainer.early_stopping.stopped_at:
        report.metric("densification_stopped_at", trainer.early_stopping.stopped_at)
        report.warn(
            "train-densification-stopped",
            f"Densification stopped early, after {trainer.early_stopping.stopped_at:,} steps, and "
            f"training ended after {trainer.schedule.steps:,}: no validation view improved by "
            f"{settings.patience:g} dB. --patience 0 trains for all steps.",
        )
    report.metric("splats", len(splats))
    if len(splats) >= 0.98 * trainer.cap:
        _warn_of_cap(trainer.cap, report)
    report.metric("train_seconds", round(time.monotonic() - started, 1))
    return trained


def _warn_of_cap(cap: int, report: Report) -> None:
    from stages.training.cap import PHOTOGRAPHS

    more = "more memory, or a higher --max-splats, may add detail"
    if report.metrics["splat_cap_from"] == PHOTOGRAPHS:
        more = "they have as many numbers as the photographs; more or larger ones may add detail"
    report.warn("train-splat-cap-reached", f"Growth stopped at the cap of {cap:,} splats; {more}.")


def _report_makers(trainer: Trainer, report: Report) -> None:
    """What made which steps, on what, and how many splats that had room for."""
    from stages.training.cap import DEVICE_MEMORY

    report.metric("makers", [asdict(maker) for maker in trainer.makers])
    if len(trainer.makers) > 1:
        ends = [f" to step {maker.step:,}" for maker in trainer.makers[1:]] + [""]
        words = (f"{m.backend} ({m.device}){e}" for m, e in zip(trainer.makers, ends, strict=True))
        report.metric("made_by", ", then ".join(words))
        report.warn(
            "train-several-makers",
            f"Trained by {report.metrics['made_by']}: none of them alone ends in these bytes.",
        )
    if trainer.cap < report.metrics["splat_cap"]:
        report.metric("splat_cap", trainer.cap)
        report.metric("splat_cap_from", DEVICE_MEMORY)
    if report.metrics["splat_cap_from"] == DEVICE_MEMORY:
        report.warn(
            "train-gpu-memory",
            f"The GPU's memory was full: trained with at most {trainer.cap:,} splats.",
        )


def make_trainer(
    reconstruction: Reconstruction,
    n_start: int,
    settings: TrainSettings,
    folder: Path,
    report: Report,
) -> Trainer:
    """Load the photographs and compute the cap, before anything grows."""
    from stages.measure.evaluation import load_evaluation_views
    from stages.scene import draw_settings_of, split_held_out, training_extent
    from stages.training.cap import cap_for, splats_determined
    from stages.training.schedule import Schedule
    from stages.training.trainer import Trainer
    from stages.training.validation import validation_rows
    from stages.training.views import load_views

    kept, held = split_held_out(reconstruction.views)
    light = corrects_light(reconstruction, settings.light, report)
    train = load_views(reconstruction.folder, kept, settings.train_side, folder, light)
    draw_settings = draw_settings_of(reconstruction.views, settings.train_side, light)
    held_out = load_evaluation_views(reconstruction.folder, held, draw_settings)
    smaller = [
        v
        for v in reconstruction.views
        if max(v.camera.width, v.camera.height) < settings.train_side
    ]
    if smaller:
        report.warn(
            "train-photographs-smaller",
            f"Used at their own size, smaller than --train-side {settings.train_side}: "
            f"{counted(len(smaller), 'photograph')}. --max-side sets how large ingest keeps them.",
        )
    told = splats_determined([view.levels[-1].camera for view in train], settings.sh_degree)
    cap = cap_for(folder, settings.max_splats, told)
    report.metric("splat_cap", cap.splats)
    report.metric("splat_cap_from", cap.origin)
    report.metric("splat_cap_free_mib", cap.free_mib)
    return Trainer(
        schedule=Schedule(
            steps=settings.steps,
            extent=training_extent(reconstruction),
            sh_degree=settings.sh_degree,
            n_start=min(n_start, cap.splats),
            seed=settings.seed,
        ),
        train=train,
        held_out=held_out,
        draw_settings=draw_settings,
        cap=cap.splats,
        folder=folder,
        report=report,
        smooth=settings.smooth,
        over_any=settings.background == "any",
        backend=backend_of_settings(settings),
        within=settings.within,
        validation=validation_rows(len(train)) if settings.patience else (),
        patience_db=settings.patience,
    )


def corrects_light(reconstruction: Reconstruction, wanted: str, report: Report) -> bool:
    """Whether photographs are brought to their median light, as `TrainSettings.light` says."""
    from stages.scene.light import NOISE_EV, spread_ev

    lights = [view.light for view in reconstruction.views]
    spread = spread_ev(lights)
    chosen = wanted == "on" or (wanted == "auto" and spread > NOISE_EV)
    report.metric("light_spread_ev", round(spread, 4))
    report.metric("light_evened", chosen and any(light is not None for light in lights))
    if chosen and wanted == "auto":
        report.warn(
            "train-light-evened",
            f"Exposure or white balance differ between photographs (by {spread:.2f} EV as a rule): "
            "they are brought to the median photograph's. Lock both in the camera to lose nothing.",
        )
    return chosen


def finished(model: Model, sh_degree: int, start: Splats, draw_settings: DrawSettings) -> Splats:
    """The model as splats: unit quaternions, without rows that are not finite."""
    import numpy as np

    from stages.scene import Splats

    norms = np.linalg.norm(model.quaternions.astype(np.float64), axis=1, keepdims=True)
    good = np.isfinite(norms[:, 0]) & (norms[:, 0] > 0)
    for array in model.arrays:
        good &= np.isfinite(array).all(tuple(range(1, array.ndim)))
    quaternions = (model.quaternions[good] / norms[good]).astype(np.float32)
    return Splats(
        model.means[good],
        quaternions,
        model.log_scales[good],
        model.opacity_logits[good],
        model.sh[good],
        np.full(int(good.sum()), sh_degree, np.uint8),
        start.origin,
        draw_settings,
    )


class TrainedResult(Protocol):
    """What `write_quality` asks of whoever trained; see `Trainer`."""

    held_out: Sequence[EvaluationView]
    draw_settings: DrawSettings
    history: list[dict[str, Any]]
    times: list[Elapsed]

    def drawn(self, camera: Camera) -> NDArray[np.float32]: ...


def write_quality(
    trainer: TrainedResult, reconstruction: Reconstruction, folder: Path, report: Report
) -> None:
    """Final held-out figures into the report; table, plot and contact sheet into the folder."""
    import numpy as np

    from stages.base.atomic import replacing
    from stages.measure.evaluation import (
        evaluate,
        evaluation_subset,
        psnr_as_taken_db,
        psnr_inside_masks_db,
    )
    from stages.scene import split_held_out
    from stages.training.charts import contact_sheet, training_plot

    found = evaluate(trainer.drawn, trainer.held_out, with_flip=True)
    if found:
        values = [score.psnr_db for score in found]
        worst = min(found, key=lambda score: score.psnr_db)
        report.metric("psnr_db", round(float(np.mean(values)), 3))
        report.metric("psnr_worst_db", round(worst.psnr_db, 3))
        report.metric("psnr_worst_photograph", worst.name)
        report.metric("psnr_spread_db", round(float(np.std(values)), 3))
        report.metric("ssim", round(float(np.mean([score.ssim for score in found])), 4))
        flips = [score.flip for score in found if score.flip is not None]
        report.metric("flip", round(float(np.mean(flips)), 4))
    else:
        report.warn(
            "train-nothing-held-out",
            "Too few photographs to hold one out: quality was not measured.",
        )
    if trainer.draw_settings.light and found:
        _, held = split_held_out(reconstruction.views)
        plain, adapted = psnr_as_taken_db(
            trainer.drawn, reconstruction.folder, held, trainer.draw_settings
        )
        report.metric("psnr_as_taken_db", round(plain, 3))
        report.metric("psnr_adapted_db", round(adapted, 3))
    inside = psnr_inside_masks_db(trainer.drawn, trainer.held_out)
    if inside is not None:
        report.metric("psnr_inside_db", round(inside, 3))
    report.metric("held_out", [asdict(score) for score in found])
    report.metric(
        "judged_side_px", max((max(p.pixels.shape[:2]) for p in trainer.held_out), default=0)
    )
    lines = ["step,splats,psnr_db,ssim"]
    for h in trainer.history:
        lines.append(
            f"{h['step']},{h['splats']},{h.get('psnr_db', float('nan')):.4f},"
            f"{h.get('ssim', float('nan')):.5f}"
        )
    # With the time that each took, which no two runs share, in the manifest alone.
    report.metric(
        "history",
        [h | asdict(t) for h, t in zip(trainer.history, trainer.times, strict=True)],
    )
    with replacing(folder / "history.csv") as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    training_plot(folder / "training.png", trainer.history)
    rows = []
    worst_row = min(range(len(found)), key=lambda i: found[i].psnr_db, default=0)
    for i in sorted({*evaluation_subset(len(found)), worst_row}) if found else ():
        photograph = trainer.held_out[i]
        image = np.clip(trainer.drawn(photograph.camera), 0.0, 1.0)
        rows.append((photograph.name, found[i].psnr_db, image, photograph.image))
    contact_sheet(folder / "held_out.png", rows)


def _does_not_fit(full: MemoryFull, cap: int) -> SplatError:
    return SplatError(
        full.code,
        given=full.given,
        wanted=full.wanted,
        hint=f"The same command again goes on from the last checkpoint with at most {cap:,} "
        f"splats; --max-splats {cap} begins anew; so does --max-splats with more, once what else "
        "uses the card is closed.",
        family=full.family,
    )


def _nothing_left() -> SplatError:
    return SplatError(
        "train-nothing-left",
        given="Every splat faded away or became invalid in training.",
        wanted="A scene that the photographs agree on.",
        hint="Check the reconstruction with `splat status`; retake blurred photographs, or try "
        "another --seed.",
        family=Family.QUALITY,
    )


def save(folder: Path, trained: TrainedSplats) -> None:
    """What `load` reads. Raises SplatError."""
    from stages.base.atomic import replacing
    from stages.scene.storage import save_splats

    save_splats(folder, trained.splats)
    with replacing(folder / _LEARNT) as temporary:
        learnt = {"dropout": trained.dropout, "overfitted": trained.overfitted}
        temporary.write_text(json.dumps(learnt) + "\n", encoding="utf-8")


def load(folder: Path) -> TrainedSplats:
    """The result of a finished folder. Raises SplatError if it is damaged."""
    from stages.scene import TrainedSplats
    from stages.scene.storage import load_splats

    splats = load_splats(folder)
    try:
        learnt = json.loads((folder / _LEARNT).read_text(encoding="utf-8"))
        return TrainedSplats(splats, bool(learnt["dropout"]), bool(learnt["overfitted"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatError(
            "train-folder-damaged",
            given=f"{folder / _LEARNT} cannot be read: {error}.",
            wanted="The file that the stage wrote.",
            hint="Delete the stage's folder and run the command again.",
            family=Family.RUN_FOLDER,
        ) from error


STAGE = Stage(
    name="train", version=17, reads=("sfm", "seed"), settings_type=TrainSettings, run=run, load=load
)
