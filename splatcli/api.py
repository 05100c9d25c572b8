"""The Python API: process photographs, open a run, draw the splats. docs/guide/python.md shows its
use; `splat process` does the same with a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from threading import Event
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from splatcli import run_settings
from stages.base.settings import UNSET, Setting, settings_of
from stages.base.stage import Numbers, Stage
from stages.raster.definition import Rendering
from stages.raster.draw import render
from stages.run import results, runfolder
from stages.run.listener import Listener
from stages.run.manifest import json_value
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_NAMES, STAGES
from stages.scene import Camera, ExportedAssets, Reconstruction, Splats
from stages.train.settings import PRESETS
from stages.viewer.sinks import eight_bits


class Options(TypedDict, total=False):
    """The options of `process`: the fields of the stages' settings, which say what they mean
    (`splat process --help`, and the help of each stage for the rest)."""

    max_side: int
    masks: Path | None
    invert_masks: bool
    mask_means: str
    rig_mask: Path | None
    depth: Path | None
    frames: int
    seed: int
    max_features: int
    features: str
    allow_partial: bool
    cameras: Path | None
    split: bool
    refine_cameras: bool
    metres: bool
    scale: tuple[str, ...]
    marker: float
    crs: str
    hold_out: bool
    max_minutes: float
    splats: Path | None
    densify: bool
    fill: bool
    steps: int
    steps_per_view: int
    splats_per_view: int
    train_side: int
    sh_degree: int
    max_splats: int
    seconds: float
    smooth: bool
    background: str
    light: str
    refine_in_training: bool
    drawing: str
    blocks: str
    within: tuple[float, ...]
    backend: str
    rounds: int
    strength: float
    max_loss_db: float
    max_mb: float
    mb_of: str
    min_psnr: float
    finetune_steps: int
    sh_loss_db: float
    sog_loss_db: float
    formats: tuple[str, ...]
    plain_steps: int
    rounding_steps: int
    name: str
    mesh_triangles: int


@dataclass(frozen=True)
class Progress:
    """How far a stage is. label: what it does. done, total: counts. numbers: figures so far."""

    stage: str
    label: str
    done: int
    total: int
    numbers: Mapping[str, Any]


@dataclass(frozen=True, repr=False)
class Scene:
    """The results of a run.

    reconstruction: posed views and sparse points. splats: the newest; of a finished run as they
    were exported. assets: the files that were written. metrics: figures by stage, as its manifest
    has them. backend: draws them.
    """

    run_folder: Path
    reconstruction: Reconstruction
    splats: Splats
    assets: ExportedAssets
    metrics: Mapping[str, Mapping[str, Any]]
    backend: str

    def __repr__(self) -> str:
        views = len(self.reconstruction.views)
        return f"Scene({str(self.run_folder)!r}, {views} views, {len(self.splats):,} splats)"

    def render(self, camera: Camera) -> Rendering:
        """Colour, alpha and depth from a camera in the world of `reconstruction`."""
        return render(self.splats, camera, backend=self.backend)

    def draw(self, camera: Camera) -> NDArray[np.uint8]:
        """sRGB picture [H, W, 3] from a camera in the world of `reconstruction`."""
        return eight_bits(self.render(camera).image)


class _Calling(Listener):
    """Calls a function with the progress of a run."""

    def __init__(self, call: Callable[[Progress], None]) -> None:
        self._call = call

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        self._call(Progress(stage.name, label, done, total, json_value(numbers)))


def process(
    photos: str | PathLike[str],
    run_folder: str | PathLike[str],
    preset: str | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
    cancel: Event | None = None,
    **options: Unpack[Options],
) -> Scene:
    """Run all stages that are not finished, and load what they made.

    Args:
        photos: folder of photographs, or a video.
        run_folder: made if missing; continued if it is a run of the same photographs. Options that
            are not given then keep the values that it records.
        preset: "preview", "standard" or "best"; None: as recorded, or "standard" for a new run.
        progress: called with each step of the work, in the thread that does it.
        cancel: once it is set, the work stops at the next safe place. Signals are left as they are.
        options: `SHARED_OPTIONS` says which stages get a field that several have. Paths may be
            texts; None takes one back. `formats` are written beside those that the run has
            exported.

    Raises SplatError as `splat process` reports it, Interrupted after `cancel`, TypeError for an
    unknown option, ValueError for an unknown preset.
    """
    from splatcli.distribution import distributed  # loads training

    if preset not in (None, *PRESETS):
        raise ValueError(f"preset {preset!r}: one of {', '.join(PRESETS)} is wanted")
    known = {one.name: one for stage in STAGES for one in settings_of(stage.settings_type)}
    if unknown := options.keys() - known.keys():
        raise TypeError(f"no stage has the option {', '.join(sorted(unknown))}")
    given = {name: _as_typed(known[name], value) for name, value in options.items()}
    pipeline = distributed(Pipeline(Path(run_folder), Path(photos)))
    settings = run_settings.requested(pipeline, given, preset)
    listener = _Calling(progress) if progress else None
    pipeline.run(settings, listener=listener, stop=cancel or Event())
    return open_run(run_folder)


def _as_typed(setting: Setting, value: Any) -> Any:
    """The value of an option as the command has it."""
    if value is None and setting.optional:
        return UNSET
    is_path = setting.kind is Path and isinstance(value, (str, PathLike))
    return Path(value).absolute() if is_path else value


def open_run(run_folder: str | PathLike[str]) -> Scene:
    """The results of a run that exists, with its newest splats; its photographs are not needed.

    Raises SplatError: run-folder-missing, no-splats-yet, and what is wrong with a file.
    """
    folder = Path(run_folder)
    if not runfolder.is_run_folder(folder):
        raise runfolder.missing(folder)
    pipeline = Pipeline(folder)
    manifests = [m for m in map(pipeline.manifest, STAGE_NAMES) if m is not None]
    exported = pipeline.manifest("export") is not None
    return Scene(
        run_folder=folder,
        reconstruction=results.reconstruction_of(pipeline),
        splats=results.newest_splats(pipeline),
        assets=pipeline.load("export") if exported else ExportedAssets(folder, ()),
        metrics={manifest.stage: manifest.metrics for manifest in manifests},
        backend=results.backend_of_run(pipeline),
    )
