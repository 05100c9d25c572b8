"""Stage 2: Capture -> Reconstruction: camera poses and a sparse point cloud.

Structure from motion by COLMAP, in a worker process. A model is used only if it passes the quality
gates (`sfm.checks.gates`). If it does not, other configurations are tried (`sfm.checks.fallbacks`),
and if none passes, the error says what to photograph differently.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stages.base.atomic import replacing
from stages.base.disk import link_or_copy
from stages.base.errors import ReconstructionError
from stages.base.settings import settings_of
from stages.base.stage import Report
from stages.base.text import counted, listed
from stages.scene import Capture, Reconstruction
from stages.sfm import finish, light, reconstruction_files
from stages.sfm.checks import acceptance, attempt_runner, fallbacks, gates
from stages.sfm.checks.circular_fisheye import warn_of_circular_fisheye
from stages.sfm.checks.gates import MOVE
from stages.sfm.checks.same_place import check_one_place
from stages.sfm.known.reconstruct import reconstruct
from stages.sfm.learned.weights import INSTALL, installed
from stages.sfm.place import metric_scale
from stages.sfm.place.crs import projected_system
from stages.sfm.place.metric_scale import KnownScale
from stages.sfm.reconstruction_files import load_reconstruction
from stages.sfm.settings import SfmSettings
from stages.sfm.worker.job import Sift, prepare_work_folder, project_of

_FEWEST_PHOTOGRAPHS = 3
_FINISHED, _WORK = "sfm.json", "work"


def run(
    inputs: Mapping[str, Any], settings: SfmSettings, folder: Path, report: Report
) -> Reconstruction:
    """Reconstruct the capture in inputs["ingest"]; see the module's docstring.

    Writes to `folder`: reconstruction.json and arrays (`load` reads them), colmap/ (undistorted
    pictures and a COLMAP model of them), sfm.json (warnings, and metrics without durations).

    Args:
        inputs: the capture, as "ingest".
        settings: see `SfmSettings`.
        folder: may hold what an interrupted run left.
        report: receives metrics, warnings and progress.

    Raises SplatError of family RECONSTRUCTION when no reconstruction passes, and Interrupted.
    """
    capture: Capture = inputs["ingest"]
    if settings.crs:
        projected_system(settings.crs)
    if settings.scale:
        metric_scale.check_distance(settings.scale, capture.photos)  # before hours of work
    if _is_finished(folder, settings):
        return _load_finished(folder, report)
    (folder / _FINISHED).unlink(missing_ok=True)  # by settings that have changed since
    if earlier := _Earlier.of(settings, report):
        return earlier.with_roles(settings, folder, report)
    if settings.cameras is not None:
        found, seconds = _from_known_cameras(capture, settings, settings.cameras, folder, report)
    else:
        found, seconds = _from_photographs(capture, settings, folder, report)
    found = _with_roles(light.with_light(found, report), settings)
    reconstruction_files.save_reconstruction(folder, found)
    report.metric("levelled", found.levelled)
    report.metric("units", found.units)
    report.metric("origin", [float(value) for value in found.origin])
    _write_finished(folder, settings, report)
    for step, duration in seconds.items():  # not in sfm.json: durations differ between runs
        report.metric(f"{step}_seconds", round(duration, 1))
    shutil.rmtree(folder / _WORK)
    return found


def _with_roles(found: Reconstruction, settings: SfmSettings) -> Reconstruction:
    """The same, whose views are all trained on if none is to be held out."""
    if settings.hold_out:
        return found
    return replace(found, views=tuple(replace(view, role="train") for view in found.views))


@dataclass(frozen=True)
class _Earlier:
    """An earlier output that differs in which views are held out, and in nothing else.

    folder: of the output. pictures: relative paths of its pictures, masks, depth maps and COLMAP
    model. durations: the metrics that `run` adds after writing sfm.json.
    """

    folder: Path
    pictures: Sequence[str]
    durations: Mapping[str, Any]

    @classmethod
    def of(cls, settings: SfmSettings, report: Report) -> _Earlier | None:
        earlier = report.earlier
        inputs = {"ingest"} if settings.cameras is None else {"ingest", "cameras"}
        if earlier is None or settings.split or not inputs <= earlier.same_inputs:
            return None
        if (earlier.settings["cameras"] is None) != (settings.cameras is None):
            return None
        pictures = sorted(n for n in earlier.outputs if n.startswith(f"{finish.COLMAP}/"))
        durations = {n: v for n, v in earlier.metrics.items() if n.endswith("_seconds")}
        return cls(earlier.folder, pictures, durations)

    def with_roles(self, settings: SfmSettings, folder: Path, report: Report) -> Reconstruction:
        """Written to `folder` as `run` would write it."""
        shutil.rmtree(folder / _WORK, ignore_errors=True)
        shutil.rmtree(folder / finish.COLMAP, ignore_errors=True)
        for name in self.pictures:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            link_or_copy(str(self.folder / name), str(folder / name))
        found = _load_finished(self.folder, report)
        views = tuple(replace(view, role="") for view in found.views)
        found = _with_roles(replace(found, folder=folder, views=views), settings)
        reconstruction_files.save_reconstruction(folder, found)
        _write_finished(folder, settings, report)
        for name, value in self.durations.items():
            report.metric(name, value)
        return found


def _from_photographs(
    capture: Capture,
    settings: SfmSettings,
    folder: Path,
    report: Report,
) -> tuple[Reconstruction, dict[str, float]]:
    """(the reconstruction, seconds by step)."""
    check_duplicates(capture, report)
    warn_of_circular_fisheye(capture, report)
    if not settings.allow_partial and all(photo.face is None for photo in capture.photos):
        check_one_place(capture.folder, capture.photos)
    features = usable_features(settings.features, report)
    work = folder / _WORK
    project, sift = project_of(capture, work, settings.seed), Sift(settings.max_features)
    prepare_work_folder(work, project, sift)
    runner = attempt_runner.AttemptRunner(
        project,
        sift,
        report,
        deadline=time.monotonic() + 60.0 * settings.max_minutes,
        allow_partial=settings.allow_partial,
        join_all=features == "learned",
    )
    attempts = fallbacks.try_configurations(
        runner.run_configuration,
        out_of_time=runner.out_of_time,
        features=features,
    )
    report.metric("attempts", [acceptance.attempt_metrics(attempt) for attempt in attempts])
    model = acceptance.accepted_model(attempts, capture, settings.allow_partial, settings.features)
    acceptance.report_warnings(attempts, model, capture, report, settings.features)
    known_scale = KnownScale(settings.scale, settings.marker, settings.crs)
    found = finish.finish(model, capture, folder, report, known_scale)
    best = fallbacks.best_attempt(attempts)
    some = gates.contradicted(best.statistics, gates.CONTRADICTED_SHARE)
    found = replace(found, contradicted=some and not settings.allow_partial)
    _report_model(found, best.statistics.mean_reprojection_error_px, capture, report)
    acceptance.report_metrics(best, model, report)
    acceptance.report_joined(attempts, model, capture, report)
    return found, runner.seconds


def _from_known_cameras(
    capture: Capture, settings: SfmSettings, cameras: Path, folder: Path, report: Report
) -> tuple[Reconstruction, dict[str, float]]:
    """(the reconstruction, no seconds)."""
    found = reconstruct(capture, cameras, settings, folder, folder / _WORK, report)
    _report_model(found, float(found.errors_px.mean()), capture, report)
    report.metric("configuration", "known cameras")
    return found, {}


def load(folder: Path) -> Reconstruction:
    """The reconstruction of a finished folder; pictures are not opened."""
    return load_reconstruction(folder)


def check_duplicates(capture: Capture, report: Report) -> None:
    """Refuse a capture of near-duplicates at once; matching would take minutes to find the same.
    Warns if some of the photographs are."""
    sources = {photo.source: photo.duplicate_of for photo in capture.photos}
    alike = [(name, first) for name, first in sources.items() if first not in ("", name)]
    different = len({first or name for name, first in sources.items()})
    if different < _FEWEST_PHOTOGRAPHS:
        raise ReconstructionError(
            "sfm-no-parallax",
            given=f"The {len(capture.photos)} photographs show only "
            f"{counted(different, 'picture')} that {'are' if different > 1 else 'is'} not nearly "
            "the same as another.",
            wanted="Depth can be measured only when the camera moves sideways.",
            hint=MOVE,
        )
    if alike:
        shown = "shows" if len(alike) == 1 else "show"
        named = listed([f"{name} (as {first})" for name, first in alike])
        report.warn(
            "sfm-near-duplicates",
            f"{len(alike)} of {len(sources)} photographs {shown} nearly the same as another: "
            f"{named}. They add no depth: take a step sideways between photographs.",
        )


def usable_features(wanted: str, report: Report) -> str:
    """The features to use: "sift" where learned ones are not installed."""
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


def _midway(settings: SfmSettings) -> dict[str, Any]:
    """The settings that may change on resuming, as JSON holds them."""
    names = [one.name for one in settings_of(SfmSettings) if one.midway]
    data: dict[str, Any] = {name: getattr(settings, name) for name in names}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in data.items()}


def _write_finished(folder: Path, settings: SfmSettings, report: Report) -> None:
    data = {
        "settings": _midway(settings),
        "metrics": report.metrics,
        "warnings": report.warnings,
    }
    with replacing(folder / _FINISHED) as path:
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def _is_finished(folder: Path, settings: SfmSettings) -> bool:
    """Whether a run with these settings was killed after its last step."""
    try:
        data = json.loads((folder / _FINISHED).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return False
    return bool(data.get("settings") == _midway(settings))


def _load_finished(folder: Path, report: Report) -> Reconstruction:
    """The output, metrics and warnings of a run that was killed after its last step."""
    data = json.loads((folder / _FINISHED).read_text(encoding="utf-8"))
    for name, value in data["metrics"].items():
        report.metric(name, value)
    for code, message in data["warnings"]:
        report.warn(code, message)
    shutil.rmtree(folder / _WORK, ignore_errors=True)
    return load(folder)
