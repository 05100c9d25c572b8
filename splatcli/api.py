"""The Python API: process a folder of photographs, and draw the splats. docs/guide/python.md shows
its use; `splat process` does the same with a progress bar."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.settings import changed
from stages.formats.output_formats import DEFAULT_FORMATS
from stages.raster.draw import render
from stages.run.listener import Listener
from stages.run.pipeline import Pipeline
from stages.run.results import reconstruction_of
from stages.run.stages import STAGE_NAMES, STAGE_OF, options_of
from stages.scene import Camera, ExportedAssets, Reconstruction, Splats
from stages.train.settings import PRESETS
from stages.viewer.sinks import eight_bits


@dataclass(frozen=True)
class Scene:
    """The results of a finished run.

    reconstruction: posed views and sparse points. splats: the last ones, as they were exported.
    assets: the files that were written. metrics: figures by stage, as its manifest has them.
    backend: draws them.
    """

    run_folder: Path
    reconstruction: Reconstruction
    splats: Splats
    assets: ExportedAssets
    metrics: Mapping[str, Mapping[str, Any]]
    backend: str

    def draw(self, camera: Camera) -> NDArray[np.uint8]:
        """sRGB picture [H, W, 3] from a camera in the world of `reconstruction`."""
        return eight_bits(render(self.splats, camera, backend=self.backend).image)


def process(
    photos: Path,
    run_folder: Path,
    preset: str = "standard",
    listener: Listener | None = None,
    **options: Any,
) -> Scene:
    """Run all stages that are not finished, and load what they made.

    Args:
        photos: folder of photographs, or a video.
        run_folder: made if missing; continued if it is a run of the same photographs.
        preset: "preview", "standard" or "best".
        listener: receives progress, if given.
        options: fields of the stages' settings; `SHARED_OPTIONS` says which stages get a field that
            several have. `formats` are written beside those that the run has exported.

    Raises SplatError as `splat process` reports it, TypeError for an unknown option, ValueError
    for an unknown preset.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset {preset!r}: one of {', '.join(PRESETS)} is wanted")
    settings: dict[str, Any] = {name: STAGE_OF[name].settings_type() for name in STAGE_NAMES}
    settings["train"] = PRESETS[preset]
    known = {field.name for found in settings.values() for field in fields(found)}
    if unknown := options.keys() - known:
        raise TypeError(f"no stage has the option {', '.join(sorted(unknown))}")
    pipeline = Pipeline(run_folder, photos)
    options["formats"] = pipeline.with_exported(options.get("formats", DEFAULT_FORMATS))
    settings = {name: changed(found, options_of(name, options)) for name, found in settings.items()}
    manifests = pipeline.run(settings, listener=listener)
    return Scene(
        run_folder=Path(run_folder),
        reconstruction=reconstruction_of(pipeline),
        splats=pipeline.load("quantise").splats,
        assets=pipeline.load("export"),
        metrics={manifest.stage: manifest.metrics for manifest in manifests},
        backend=settings["train"].backend,
    )
