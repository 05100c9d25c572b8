"""The trainer of a run, made from its settings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from stages.base.stage import Report
from stages.base.text import counted
from stages.evaluate.evaluation import EvaluationView, load_evaluation_views
from stages.raster.backends import backend_of
from stages.scene import (
    Camera,
    Reconstruction,
    Splats,
    draw_settings_of,
    split_held_out,
    training_extent,
)
from stages.scene.light import spread_ev
from stages.train.camera_refinement import CameraRefinement
from stages.train.cap import Cap, cap_for, splats_determined
from stages.train.schedule import DENSIFYING_PART, LAST_PART, PUBLISHED_STEPS, Schedule
from stages.train.settings import STEPS_PER_VIEW, STEPS_PER_VIEW_SQUARED, TrainSettings
from stages.train.trainer import Trainer, TrainingTask
from stages.train.views import load_views

LEAST_STEPS = 2000  # of a run, however few its training views


def make_trainer(
    reconstruction: Reconstruction,
    start: Splats,
    settings: TrainSettings,
    folder: Path,
    report: Report,
) -> Trainer:
    """Load the training views and choose the cap of splats. Raises SplatError.

    start: what was trained before keeps its drawing, its SH degree at least, and all its splats.
    It gets the last part of a run, or the part that densifies, too.
    """
    began = time.monotonic()
    kept, held = split_held_out(reconstruction.views)
    light = corrects_light(reconstruction, settings.light, report)
    train = load_views(reconstruction.folder, kept, settings.train_side, folder, light)
    given = settings.splats is not None
    most_steps = max(settings.steps, most_steps_for(settings.steps_per_view, len(train)))
    trains = settings.steps > 0 or not given
    if trains and (settings.seconds or not settings.steps):  # a time limit plans fewer
        settings = replace(settings, steps=most_steps)
    antialias = start.draw_settings.antialias if given else settings.antialias
    sh_degree = max(settings.sh_degree if settings.steps else 0, start.sh_degree)
    draw_settings = draw_settings_of(reconstruction, settings.train_side, light, antialias)
    held_out = load_evaluation_views(reconstruction.folder, held, draw_settings)
    _warn_of_small_photographs(reconstruction, settings, report)
    cameras = {view.name: view.levels[-1].camera for view in train}
    cap = _cap(start, settings, folder, [*cameras.values()], sh_degree)
    report.metric("splat_cap_free_mib", cap.free_mib)
    extent = training_extent(reconstruction)
    refinement = _refinement(settings, cameras, held_out, extent)
    backend = settings.backend if refinement is None else _on_the_host(settings.backend, report)
    task = TrainingTask(
        views=train,
        held_out=held_out,
        draw_settings=draw_settings,
        folder=folder,
        report=report,
        smooth=settings.smooth,
        any_background=settings.background == "any",
        backend=backend,
        seconds=settings.seconds and max(settings.seconds - (time.monotonic() - began), 1.0),
        most_steps=most_steps,
        within=settings.within,
    )
    schedule = Schedule(
        steps=settings.steps,
        extent=extent,
        sh_degree=sh_degree,
        n_start=min(len(start), cap.splats),
        seed=settings.seed,
        since=_part(settings),
    )
    return Trainer(task, schedule, cap, refinement)


def _part(settings: TrainSettings) -> tuple[int, float]:
    """`Schedule.since` of the run."""
    if settings.splats is None:
        return 0, 0.0
    return DENSIFYING_PART if settings.densify or settings.within else LAST_PART


def _cap(
    start: Splats,
    settings: TrainSettings,
    folder: Path,
    cameras: Sequence[Camera],
    sh_degree: int,
) -> Cap:
    """cameras: of the training views."""
    determined = splats_determined(cameras, sh_degree)
    limits = determined, settings.splats_per_view * len(cameras)
    if settings.splats is None:
        return cap_for(folder, settings.max_splats, *limits)
    most = len(start) if _part(settings) == LAST_PART else settings.max_splats
    return cap_for(folder, most, *limits).for_given(len(start))


def _refinement(
    settings: TrainSettings,
    cameras: Mapping[str, Camera],
    held_out: Sequence[EvaluationView],
    extent: float,
) -> CameraRefinement | None:
    """cameras: of the training views, by name."""
    if not settings.refine_in_training:
        return None
    return CameraRefinement.of({**cameras, **{v.name: v.camera for v in held_out}}, extent)


def _warn_of_small_photographs(
    reconstruction: Reconstruction, settings: TrainSettings, report: Report
) -> None:
    if not settings.steps:
        return
    side = settings.train_side
    views = [v for v in reconstruction.views if max(v.camera.width, v.camera.height) < side]
    if smaller := len({view.frame or view.name for view in views}):
        report.warn(
            "train-photographs-smaller",
            f"Used at their own size, smaller than --train-side {side}: "
            f"{counted(smaller, 'photograph')}. A larger --max-side helps only where ingest made "
            "them so small.",
        )


def most_steps_for(steps_per_view: int, views: int) -> int:
    """How many steps so many training views are worth. steps_per_view: see `TrainSettings`."""
    each = steps_per_view or max(STEPS_PER_VIEW, STEPS_PER_VIEW_SQUARED * views)
    return min(max(LEAST_STEPS, each * views), PUBLISHED_STEPS)


def _on_the_host(backend: str, report: Report) -> str:
    """The backend, or the CPU's instead of a GPU's, whose steps do not give out their gradients."""
    if not backend_of(backend).needs_hardware:
        return backend
    report.warn(
        "train-refinement-on-cpu",
        "Cameras are refined on the CPU: --refine-in-training does not use the GPU yet.",
    )
    return "cpu"


def corrects_light(reconstruction: Reconstruction, choice: str, report: Report) -> bool:
    """Whether the views are brought to their median exposure and white balance: if structure from
    motion found that the camera changed these, unless the `choice` is "off"."""
    spread = spread_ev(view.light for view in reconstruction.views)
    corrects = choice != "off" and spread > 0
    report.metric("light_corrected", corrects)
    if corrects:
        report.warn(
            "train-light-evened",
            f"Exposure or white balance differ between photographs (typically by {spread:.2f} EV): "
            "they are brought to the median photograph's.",
        )
    return corrects
