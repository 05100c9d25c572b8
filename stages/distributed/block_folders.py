"""Run folders of blocks: with some views of another run and given initial splats, ready to train.

`splat status`, `splat view` and `splat train` accept them. Pictures are not copied: a block's views
refer to the files of the whole run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.base.libraries import versions
from stages.run.digests import combined_digest, record_files
from stages.run.manifest import MANIFEST, Manifest
from stages.run.pipeline import Pipeline
from stages.run.runfile import RunFile
from stages.scene import Reconstruction, Splats, save_splats
from stages.sfm.reconstruction_files import save_reconstruction
from stages.train.settings import TrainSettings

_POINTS = 100_000  # at most, of the sparse cloud, which only tells the extent of the scene


def begin(
    whole: Pipeline, folder: Path, part: Reconstruction, start: Splats, settings: TrainSettings
) -> None:
    """Make `folder` a run folder in which ingest, sfm and seed have finished. Equal inputs give
    equal folders, so that this can be repeated.

    Args:
        whole: the run of the whole scene, which has the pictures.
        part: the output of sfm.
        start: the output of seed.
        settings: of training.

    Raises SplatError, OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pipeline = Pipeline(folder)
    ingest = _of(whole, "ingest")
    _finish(pipeline.stage_folder("ingest"), replace(ingest, outputs={}))
    place = pipeline.stage_folder("sfm")
    place.mkdir(exist_ok=True)
    save_reconstruction(place, _relocated(part, place))
    sfm = _finish(place, _of(whole, "sfm"))
    place = pipeline.stage_folder("seed")
    place.mkdir(exist_ok=True)
    save_splats(place, start)
    seed = _of(whole, "seed")
    _finish(place, replace(seed, inputs={"sfm": sfm.output_digest}))
    recorded = whole.recorded_settings()
    RunFile().updated({**recorded, "train": settings}).write(folder)


def _of(whole: Pipeline, name: str) -> Manifest:
    manifest = whole.manifest(name)
    assert manifest is not None, f"{name} runs before training"
    return manifest


def _finish(folder: Path, like: Manifest) -> Manifest:
    """Write a manifest like `like`, for the files in the folder."""
    folder.mkdir(exist_ok=True)
    outputs = record_files(folder, leave_out=frozenset([MANIFEST]))
    metrics: Mapping[str, Any] = {"trained_by": "the run that this is a block of"}
    manifest = replace(
        like,
        outputs=outputs,
        output_digest=combined_digest(outputs) if outputs else like.output_digest,
        seconds=0.0,
        cpu_seconds=0.0,
        peak_memory_mib=0.0,
        libraries=versions(),
        metrics=dict(metrics),
        warnings=[],
    )
    manifest.write(folder)
    return manifest


def _relocated(part: Reconstruction, place: Path) -> Reconstruction:
    """The reconstruction with paths of its pictures relative to `place`, and a sample of its
    points."""
    lead = Path(os.path.relpath(part.folder, place))
    views = tuple(
        replace(
            view,
            image=(lead / view.image).as_posix(),
            mask=(lead / view.mask).as_posix() if view.mask else "",
            depth=(lead / view.depth).as_posix() if view.depth else "",
        )
        for view in part.views
    )
    some = slice(None, None, max(1, len(part.points) // _POINTS))
    return replace(
        part,
        views=views,
        points=part.points[some],
        colours=part.colours[some],
        errors_px=part.errors_px[some],
        tracks=part.tracks[some],
    )
