"""Capture -> Reconstruction: where each photograph was taken, and a sparse cloud of points.

Structure from motion by COLMAP, in a process of its own. The result is used only if it passes the
gates of `stages.structure.gates`; if it does not, other ways are tried, and if none helps, the
user is told what to photograph differently.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base import threads
from stages.base.errors import Family, SplatError
from stages.base.stage import Report, Stage
from stages.base.text import counted

if TYPE_CHECKING:
    from stages.scene import Capture, Reconstruction
    from stages.structure.chunks import ChunkExecutor
    from stages.structure.fallbacks import Attempt, Attempts
    from stages.structure.job import Job
    from stages.structure.sparse_model import SparseModel

_FEWEST_PHOTOGRAPHS = 3
_FEWEST_PARTIAL_POINTS = 50
_FINISHED = "sfm.json"
_WORK = "work"
_NAMED = 12  # photographs that a message names before it counts the rest


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion."""

    seed: int = field(
        default=0,
        metadata={
            "panel": "Advanced",
            "help": "Seed of every random choice; same seed, same result.",
            "min": 0,
            "max": 2**31 - 1,
        },
    )
    max_features: int = field(
        default=12_288,
        metadata={
            "help": "Features to look for in each photograph (about).",
            "min": 100,
            "max": 1_000_000,
        },
    )
    matching: str = field(
        default="auto",
        metadata={
            "help": "Which photographs to compare: exhaustive (every pair), sequential (neighbours "
            "in order of name) or auto (those that look alike at a first look).",
            "choices": ("auto", "exhaustive", "sequential"),
        },
    )
    allow_partial: bool = field(
        default=False,
        metadata={
            "panel": "Advanced",
            "help": "Go on with the best reconstruction found even if it fails its gates.",
        },
    )
    cameras: Path | None = field(
        default=None,
        metadata={
            "panel": "Known cameras",
            "help": "File or folder of cameras that are known already, of COLMAP, nerfstudio, a "
            "synthetic NeRF scene, LLFF, OpenSfM, Bundler, Metashape or RealityScan: nothing "
            "is searched.",
            "affects_output": False,  # its content does, which is an input
        },
    )
    split: bool = field(
        default=False,
        metadata={
            "panel": "Known cameras",
            "help": "Keep the training and test photographs that --cameras tells apart.",
            "needs": "cameras",
        },
    )
    refine_cameras: bool = field(
        default=False,
        metadata={
            "panel": "Known cameras",
            "help": "Move the cameras of --cameras to where the photographs' matches want them; "
            "their lenses stay as they are.",
            "needs": "cameras",
        },
    )
    metres: bool = field(
        default=False,
        metadata={
            "panel": "Known cameras",
            "help": "The cameras of --cameras are in metres, as those of phones' AR sessions are.",
            "needs": "cameras",
        },
    )
    scale: tuple[str, ...] = field(
        default=(),
        metadata={
            "panel": "Known cameras",
            "help": "Two photographs and how far apart their cameras were (metres).",
            "together": "A B METRES",
        },
    )
    marker: float = field(
        default=0.0,
        metadata={
            "panel": "Known cameras",
            "help": "Side of the ArUco markers that lie in the scene, alone or on a ChArUco board "
            "(metres); 0: there are none.",
            "min": 0.0,
            "max": 1000.0,
        },
    )
    max_minutes: float = field(
        default=120.0,
        metadata={
            "help": "Give up after this time (minutes).",
            "min": 0.1,
            "max": 100_000,
            "affects_output": False,
        },
    )


def run(
    inputs: Mapping[str, Any],
    settings: SfmSettings,
    folder: Path,
    report: Report,
    executor: ChunkExecutor | None = None,
) -> Reconstruction:
    """Reconstruct the capture in inputs["ingest"]; see the module's docstring. hands: who does
    shares of features and matching (`structure.shares`), which changes no byte.

    Leaves in `folder`: reconstruction.json and arrays (`load` reads them), colmap/ (undistorted
    pictures and a COLMAP model of them), sfm.json (metrics but for seconds, and warnings). Raises
    SplatError of family RECONSTRUCTION when no reconstruction passes, and Interrupted.
    """
    from stages.structure import (
        attempt_runner,
        fallbacks,
        finish,
        light,
        metric_scale,
        reconstruction_files,
    )

    capture: Capture = inputs["ingest"]
    _check(capture)
    if settings.scale:
        metric_scale.check_distance(settings.scale, capture)  # now, not when cameras are found
    if (folder / _FINISHED).exists():
        return _again(folder, report)
    work = folder / _WORK
    if settings.cameras is not None:
        return _with_known_cameras(capture, settings, settings.cameras, folder, report)
    _check_different(capture)
    base = _base_job(capture, settings, work)
    _reuse_or_clear(work, base)
    bench = attempt_runner.AttemptRunner(
        folder=work,
        base=base,
        report=report,
        deadline=time.monotonic() + 60.0 * settings.max_minutes,
        allow_partial=settings.allow_partial,
        executor=executor,
    )
    climbed = fallbacks.try_configurations(
        bench.try_rung,
        already_exhaustive=base.matching == "exhaustive",
        out_of_time=bench.out_of_time,
    )
    best = climbed.best
    report.metric("rungs", [_rung_figures(attempt) for attempt in climbed.attempts])
    model = _accepted(best, settings, capture)
    _tell(best, climbed, capture, report)
    found = finish.finish(
        model, capture, folder, report, metric_scale.KnownScale(settings.scale, settings.marker)
    )
    reconstruction = light.with_light(found, report)
    reconstruction_files.save_reconstruction(folder, reconstruction)
    _model_metrics(best, model, reconstruction, capture, report)
    report.metric("pairs_looked_at", bench.pairs_looked_at())
    report.metric("pairs_matched", best.pairs_matched)
    report.metric("pairs_verified", best.pairs_verified)
    _write_finished(folder, report)
    for step, seconds in bench.seconds_by_step().items():  # the clock never says the same twice
        report.metric(f"{step}_seconds", round(seconds, 1))
    shutil.rmtree(work)
    return reconstruction


def _with_known_cameras(
    capture: Capture, settings: SfmSettings, cameras: Path, folder: Path, report: Report
) -> Reconstruction:
    import numpy as np

    from stages.structure import known_cameras, light, metric_scale, reconstruction_files

    deadline = time.monotonic() + 60.0 * settings.max_minutes
    found = known_cameras.reconstruct(
        capture,
        cameras,
        folder,
        folder / _WORK,
        report,
        split=settings.split,
        refine=settings.refine_cameras,
        allow_partial=settings.allow_partial,
        seed=settings.seed,
        max_features=settings.max_features,
        size=metric_scale.KnownScale(
            settings.scale, settings.marker, float(settings.metres), "--metres"
        ),
        seconds_left=lambda: deadline - time.monotonic(),
    )
    found = light.with_light(found, report)
    reconstruction_files.save_reconstruction(folder, found)
    names = {view.name for view in found.views}
    report.metric("photographs", len(capture.photos))
    report.metric("registered", len(found.views))
    report.metric("left_out", [p.name for p in capture.photos if p.name not in names])
    report.metric("points", len(found.points))
    report.metric("mean_reprojection_error_px", round(float(np.mean(found.errors_px)), 4))
    report.metric("rung", "cameras given")
    report.metric("levelled", found.levelled)
    report.metric("units", found.units)
    _write_finished(folder, report)
    shutil.rmtree(folder / _WORK)
    return found


def load(folder: Path) -> Reconstruction:
    """The reconstruction of a finished folder; pictures are not opened."""
    from stages.structure.reconstruction_files import load_reconstruction

    return load_reconstruction(folder)


def _check(capture: Capture) -> None:
    if len(capture.photos) < _FEWEST_PHOTOGRAPHS:
        raise SplatError(
            "sfm-too-few-photographs",
            given=f"The capture holds {counted(len(capture.photos), 'usable photograph')}.",
            wanted=f"At least {_FEWEST_PHOTOGRAPHS}; 20 to 50 do an object or a room well.",
            hint="Take photographs in small steps around the scene, with 60-80 % overlap.",
            family=Family.INPUT,
        )


def _check_different(capture: Capture) -> None:
    """Near-duplicates would be searched for minutes before the same is said."""
    from stages.structure.gates import MOVE

    different = len({photo.duplicate_of or photo.name for photo in capture.photos})
    if different < _FEWEST_PHOTOGRAPHS:
        raise SplatError(
            "sfm-no-parallax",
            given=f"The {len(capture.photos)} photographs show only "
            f"{counted(different, 'picture')} that {'are' if different > 1 else 'is'} not nearly "
            "the same as another.",
            wanted="Depth shows only when the camera moves sideways.",
            hint=MOVE,
            family=Family.RECONSTRUCTION,
        )


def _base_job(capture: Capture, settings: SfmSettings, work: Path) -> Job:
    """The standard job: one camera for all photographs of the same key and size."""
    from stages.structure.job import CameraGuess, Job

    positions: dict[tuple[str, int, int], int] = {}
    guesses: list[CameraGuess] = []
    camera_of = []
    for photo in capture.photos:
        key = (photo.camera, photo.width, photo.height)
        if key not in positions:
            positions[key] = len(guesses)
            guesses.append(CameraGuess(photo.width, photo.height, photo.focal_px))
        camera_of.append(positions[key])
    return Job(
        step="",
        images_root=str(capture.folder.resolve()),
        database=str(work / "base.db"),
        out="",
        progress="",
        names=tuple(photo.image for photo in capture.photos),
        masks=tuple(photo.mask for photo in capture.photos),
        camera_of=tuple(camera_of),
        cameras=tuple(guesses),
        seed=settings.seed,
        threads=threads.count(),
        max_features=settings.max_features,
        matching="chosen" if settings.matching == "auto" else settings.matching,
    )


def _reuse_or_clear(work: Path, base: Job) -> None:
    """Keep what an interrupted run left only if it was about the very same job."""
    described = work / "base.json"
    # Where things lie and how many threads work on them changes nothing.
    plain = asdict(base) | {"images_root": "", "database": "", "threads": 0}
    wanted = json.dumps(plain, ensure_ascii=False, sort_keys=True)
    try:
        same = described.read_text(encoding="utf-8") == wanted
    except (OSError, ValueError):
        same = False
    if not same:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        described.write_text(wanted, encoding="utf-8")


def _accepted(best: Attempt, settings: SfmSettings, capture: Capture) -> SparseModel:
    """The model to go on with, or the error that says why there is none."""
    model = best.result.model if best.result is not None else None
    usable = model is not None and len(model.names) >= _FEWEST_PHOTOGRAPHS
    if model is not None and usable and best.passed:
        return model
    enough = model is not None and len(model.points) >= _FEWEST_PARTIAL_POINTS
    if model is not None and usable and enough and settings.allow_partial:
        return model
    worst = best.failures[0]
    groups = best.result.groups if best.result is not None else ()
    code, given = worst.code, worst.given
    if code == "sfm-too-few-registered" and len(groups) > 1:
        code = "sfm-separate-groups"
        names = {photo.image: photo.name for photo in capture.photos}
        described = "; ".join(
            f"{len(group)} ({_listed(sorted(names[image] for image in group), 3)})"
            for group in groups[:4]
        )
        given += f" The largest groups that hang together: {described}."
    raise SplatError(
        code, given=given, wanted=worst.wanted, hint=worst.hint, family=Family.RECONSTRUCTION
    )


def _tell(best: Attempt, climbed: Attempts, capture: Capture, report: Report) -> None:
    """Warnings about what is not as it should be."""
    assert best.result is not None
    assert best.result.model is not None
    registered = set(best.result.model.names)
    left_out = [photo.name for photo in capture.photos if photo.image not in registered]
    if left_out:
        one = len(left_out) == 1
        report.warn(
            "sfm-photographs-left-out",
            f"{len(left_out)} of {len(capture.photos)} photographs {'was' if one else 'were'} left "
            f"out, because {'it' if one else 'they'} could not be placed: {_listed(left_out)}. "
            "More overlap with the others would help.",
        )
    if len(best.result.groups) > 1:
        sizes = ", ".join(str(len(group)) for group in best.result.groups)
        report.warn(
            "sfm-several-models",
            f"The photographs fell into separate models of {sizes}; the largest is used.",
        )
    if best.passed and best is not climbed.attempts[0]:
        report.warn(
            "sfm-second-try",
            f"The usual way did not work ({climbed.attempts[0].failures[0].given}) but "
            f"another did: {best.rung.name}. Look at the result with care.",
        )
    _tell_doubts(best, report)
    for failure in best.failures:
        report.warn(failure.code, f"Accepted all the same: {failure.given} {failure.wanted}")


def _tell_doubts(best: Attempt, report: Report) -> None:
    """What would be a failure if there were more of it."""
    from stages.structure.gates import borderline_failures

    failed = {failure.code for failure in best.failures}
    for doubt in borderline_failures(best.figures):
        if doubt.code not in failed:
            report.warn(doubt.code, f"{doubt.given} {doubt.wanted} {doubt.hint}")


def _listed(names: list[str], most: int = _NAMED) -> str:
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def _rung_figures(attempt: Attempt) -> dict[str, Any]:
    figures = {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in asdict(attempt.figures).items()
    }
    return {
        "rung": attempt.rung.name,
        "passed": attempt.passed,
        "failures": [failure.code for failure in attempt.failures],
        "keypoints_median": attempt.keypoints_median,
        **figures,
    }


def _model_metrics(
    best: Attempt,
    model: SparseModel,
    reconstruction: Reconstruction,
    capture: Capture,
    report: Report,
) -> None:
    registered = set(model.names)
    figures = best.figures
    report.metric("photographs", len(capture.photos))
    report.metric("registered", len(model.names))
    report.metric("left_out", [p.name for p in capture.photos if p.image not in registered])
    report.metric("points", len(model.points))
    report.metric("mean_reprojection_error_px", round(figures.mean_reprojection_error_px, 4))
    report.metric("mean_track_length", round(figures.mean_track_length, 3))
    report.metric(
        "median_triangulation_angle_deg", round(figures.median_triangulation_angle_deg, 2)
    )
    report.metric("baseline_over_depth", round(figures.baseline_over_depth, 4))
    report.metric("keypoints_median", best.keypoints_median)
    report.metric("focal_px", [round(float(f), 2) for f in model.camera_params[:, 0]])
    report.metric("distortion", [round(float(k), 5) for k in model.camera_params[:, 3]])
    report.metric("rung", best.rung.name)
    report.metric("levelled", reconstruction.levelled)
    report.metric("units", reconstruction.units)
    report.metric("origin", [float(value) for value in reconstruction.origin])


def _write_finished(folder: Path, report: Report) -> None:
    from stages.base.atomic import replacing

    data = {"metrics": report.metrics, "warnings": report.warnings}
    with replacing(folder / _FINISHED) as path:
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def _again(folder: Path, report: Report) -> Reconstruction:
    """What a run that was killed just after its end had found and said."""
    data = json.loads((folder / _FINISHED).read_text(encoding="utf-8"))
    for name, value in data["metrics"].items():
        report.metric(name, value)
    for code, message in data["warnings"]:
        report.warn(code, message)
    shutil.rmtree(folder / _WORK, ignore_errors=True)
    return load(folder)


STAGE = Stage(
    name="sfm", version=10, reads=("ingest",), settings_type=SfmSettings, run=run, load=load
)
