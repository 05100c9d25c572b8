"""Stage 2: Capture -> Reconstruction: camera poses and a sparse point cloud.

Structure from motion by COLMAP, in a worker process. A model is used only if it passes the quality
gates (`sfm.checks.gates`). If it does not, other configurations are tried (`sfm.checks.fallbacks`),
and if none passes, the error says what to photograph differently.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.errors import ReconstructionError
from stages.base.settings import setting
from stages.base.stage import Report, Stage
from stages.base.text import counted

if TYPE_CHECKING:
    from stages.scene import Capture, Reconstruction
    from stages.sfm.worker.chunks import ChunkExecutor

_FEWEST_PHOTOGRAPHS = 3
_FINISHED = "sfm.json"
_WORK = "work"


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion."""

    seed: int = setting(
        0,
        "Seed of every random choice; same seed, same result.",
        panel="Advanced",
        min=0,
        max=2**31 - 1,
    )
    max_features: int = setting(
        12_288, "Approximate number of SIFT features in each photograph.", min=100, max=1_000_000
    )
    matching: str = setting(
        "auto",
        "Pairs of photographs to match: exhaustive (every pair), sequential "
        "(neighbours in order of name) or auto (those with similar features).",
        choices=("auto", "exhaustive", "sequential"),
    )
    features: str = setting(
        "auto",
        "sift; auto (SIFT, and learned features where it leaves photographs out, if they are "
        "installed); or learned (both from the start).",
        panel="Advanced",
        choices=("auto", "sift", "learned"),
    )
    allow_partial: bool = setting(
        False,
        "Use the best reconstruction found even if it fails the quality gates.",
        panel="Advanced",
    )
    cameras: Path | None = setting(
        None,
        "File or folder of known camera poses, of COLMAP, nerfstudio, a synthetic NeRF "
        "scene, LLFF, OpenSfM, ODM, Bundler, Metashape, RealityScan, Pix4D, ARKit or Polycam; they "
        "are not estimated.",
        panel="Known cameras",
        affects_output=False,  # its content does, and that is an input
    )
    split: bool = setting(
        False,
        "Use the split into training and test photographs of --cameras.",
        panel="Known cameras",
        needs="cameras",
    )
    refine_cameras: bool = setting(
        False,
        "Refine the poses of --cameras by bundle adjustment; intrinsics stay fixed.",
        panel="Known cameras",
        needs="cameras",
    )
    metres: bool = setting(
        False,
        "The poses of --cameras are in metres, as those of phones' AR sessions are.",
        panel="Known cameras",
        needs="cameras",
    )
    scale: tuple[str, ...] = setting(
        (),
        "Two photographs and the distance between their cameras (metres).",
        panel="Known cameras",
        together="A B METRES",
    )
    marker: float = setting(
        0.0,
        "Side of the ArUco markers in the scene, alone or on a ChArUco board "
        "(metres); 0: there are none.",
        panel="Known cameras",
        min=0.0,
        max=1000.0,
    )
    crs: str = setting(
        "",
        "Turn a scene with GPS to this grid: a projected coordinate reference system in metres, "
        "such as EPSG:25832.",
        panel="Known cameras",
        pattern=r"(EPSG:[0-9]{4,6})?",
        wanted="An EPSG code, such as EPSG:25832.",
    )
    max_minutes: float = setting(
        120.0,
        "Stop with an error after this time (minutes).",
        min=0.1,
        max=100_000,
        affects_output=False,
    )


def run(
    inputs: Mapping[str, Any],
    settings: SfmSettings,
    folder: Path,
    report: Report,
    executor: ChunkExecutor | None = None,
) -> Reconstruction:
    """Reconstruct the capture in inputs["ingest"]; see the module's docstring.

    Writes to `folder`: reconstruction.json and arrays (`load` reads them), colmap/ (undistorted
    pictures and a COLMAP model of them), sfm.json (warnings, and metrics without durations).

    Args:
        inputs: the capture, as "ingest".
        settings: see `SfmSettings`.
        folder: may hold what an interrupted run left.
        report: receives metrics, warnings and progress.
        executor: runs chunks of features and matching (`sfm.worker.chunks`) in parallel; the result
            has the same bytes.

    Raises SplatError of family RECONSTRUCTION when no reconstruction passes, and Interrupted.
    """
    from stages.sfm import light, reconstruction_files
    from stages.sfm.place import metric_scale
    from stages.sfm.place.crs import projected_system

    capture: Capture = inputs["ingest"]
    if settings.crs:
        projected_system(settings.crs)
    if settings.scale:
        metric_scale.check_distance(settings.scale, capture.photos)  # before hours of work
    if (folder / _FINISHED).exists():
        return _load_finished(folder, report)
    if settings.cameras is not None:
        found, seconds = _from_known_cameras(capture, settings, settings.cameras, folder, report)
    else:
        found, seconds = _from_photographs(capture, settings, folder, report, executor)
    found = light.with_light(found, report)
    reconstruction_files.save_reconstruction(folder, found)
    report.metric("levelled", found.levelled)
    report.metric("units", found.units)
    report.metric("origin", [float(value) for value in found.origin])
    _write_finished(folder, report)
    for step, duration in seconds.items():  # not in sfm.json: durations differ between runs
        report.metric(f"{step}_seconds", round(duration, 1))
    shutil.rmtree(folder / _WORK)
    return found


def _from_photographs(
    capture: Capture,
    settings: SfmSettings,
    folder: Path,
    report: Report,
    executor: ChunkExecutor | None,
) -> tuple[Reconstruction, dict[str, float]]:
    """(the reconstruction, seconds by step)."""
    from stages.sfm import finish
    from stages.sfm.checks import acceptance, attempt_runner, fallbacks
    from stages.sfm.place import metric_scale
    from stages.sfm.worker.job import job_of, prepare_work_folder

    _check_duplicates(capture)
    features = usable_features(settings.features, report)
    work = folder / _WORK
    job = job_of(capture, work, settings.seed, settings.max_features, settings.matching)
    prepare_work_folder(work, job)
    runner = attempt_runner.AttemptRunner(
        folder=work,
        base=job,
        report=report,
        deadline=time.monotonic() + 60.0 * settings.max_minutes,
        allow_partial=settings.allow_partial,
        join_all=features == "learned",
        executor=executor,
    )
    attempts = fallbacks.try_configurations(
        runner.run_configuration,
        out_of_time=runner.out_of_time,
        features=features,
    )
    report.metric("attempts", [acceptance.attempt_metrics(attempt) for attempt in attempts])
    model = acceptance.accepted_model(attempts, capture, settings.allow_partial, settings.features)
    acceptance.report_warnings(attempts, model, capture, report, settings.features)
    known_scale = metric_scale.KnownScale(settings.scale, settings.marker, settings.crs)
    found = finish.finish(model, capture, folder, report, known_scale)
    best = fallbacks.best_attempt(attempts)
    _report_model(found, best.statistics.mean_reprojection_error_px, capture, report)
    acceptance.report_metrics(best, model, report)
    acceptance.report_joined(attempts, model, capture, report)
    return found, runner.seconds


def _from_known_cameras(
    capture: Capture, settings: SfmSettings, cameras: Path, folder: Path, report: Report
) -> tuple[Reconstruction, dict[str, float]]:
    """(the reconstruction, no seconds)."""
    from stages.sfm.known import known_cameras
    from stages.sfm.place.metric_scale import KnownScale

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
        known_scale=KnownScale(settings.scale, settings.marker, settings.crs, settings.metres),
        seconds_left=lambda: deadline - time.monotonic(),
    )
    _report_model(found, float(found.errors_px.mean()), capture, report)
    report.metric("configuration", "known cameras")
    return found, {}


def load(folder: Path) -> Reconstruction:
    """The reconstruction of a finished folder; pictures are not opened."""
    from stages.sfm.reconstruction_files import load_reconstruction

    return load_reconstruction(folder)


def _check_duplicates(capture: Capture) -> None:
    """Refuse a capture of near-duplicates at once; matching would take minutes to find the same."""
    from stages.sfm.checks.gates import MOVE

    different = len({photo.duplicate_of or photo.source for photo in capture.photos})
    if different < _FEWEST_PHOTOGRAPHS:
        raise ReconstructionError(
            "sfm-no-parallax",
            given=f"The {len(capture.photos)} photographs show only "
            f"{counted(different, 'picture')} that {'are' if different > 1 else 'is'} not nearly "
            "the same as another.",
            wanted="Depth can be measured only when the camera moves sideways.",
            hint=MOVE,
        )


def usable_features(wanted: str, report: Report) -> str:
    """The features to use: "sift" where learned ones are not installed."""
    from stages.sfm.learned.weights import INSTALL, installed

    if wanted == "sift" or installed():
        return wanted
    if wanted == "learned":
        report.warn(
            "sfm-learned-not-installed",
            f"Learned features are not installed ({INSTALL} installs them); the run goes on with "
            "SIFT alone.",
        )
    return "sift"


def _report_model(
    found: Reconstruction, mean_error_px: float, capture: Capture, report: Report
) -> None:
    names = {name for view in found.views for name in (view.name, view.frame)}
    report.metric("photographs", len(capture.photos))
    report.metric("registered_images", len(found.views))
    lost = dict.fromkeys(photo.source for photo in capture.photos if photo.name not in names)
    report.metric("unregistered_images", list(lost))
    report.metric("points", len(found.points))
    report.metric("mean_reprojection_error_px", round(mean_error_px, 4))


def _write_finished(folder: Path, report: Report) -> None:
    from stages.base.atomic import replacing

    data = {"metrics": report.metrics, "warnings": report.warnings}
    with replacing(folder / _FINISHED) as path:
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def _load_finished(folder: Path, report: Report) -> Reconstruction:
    """The output, metrics and warnings of a run that was killed after its last step."""
    data = json.loads((folder / _FINISHED).read_text(encoding="utf-8"))
    for name, value in data["metrics"].items():
        report.metric(name, value)
    for code, message in data["warnings"]:
        report.warn(code, message)
    shutil.rmtree(folder / _WORK, ignore_errors=True)
    return load(folder)


STAGE = Stage(
    name="sfm", version=23, reads=("ingest",), settings_type=SfmSettings, run=run, load=load
)
