"""Which attempt is used, or the error if none can be; warnings and metrics about it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.base.text import listed
from stages.scene import Capture
from stages.sfm.checks.fallbacks import LEARNED, Attempt, best_attempt
from stages.sfm.checks.gates import IF_RIGHT, THRESHOLDS, borderline_failures, failure
from stages.sfm.learned.weights import INSTALL, installed
from stages.sfm.worker.sparse_model import SparseModel

_FEWEST_PARTIAL_POINTS = 50


def accepted_model(
    attempts: list[Attempt], capture: Capture, allow_partial: bool, features: str = "sift"
) -> SparseModel:
    """The model of the best attempt. Raises SplatError if it failed a gate, unless `allow_partial`
    and the model has enough photographs and points. features: the setting."""
    best = best_attempt(attempts)
    model = best.result.model
    if model is not None and len(model.names) >= THRESHOLDS.fewest_views:
        enough = len(model.points) >= _FEWEST_PARTIAL_POINTS
        if best.passed or (enough and allow_partial):
            return model
    if best.configuration.learned and attempts[0].failures[0].code == "sfm-too-few-features":
        best = attempts[0]  # the photographs show nothing, and the gates after that do not say so
    worst = with_hint(best.failures[0], features)
    if worst.code == "sfm-too-few-registered" and len(best.result.groups) > 1:
        names = {photo.image: photo.source for photo in capture.photos}
        described = "; ".join(
            f"{len(group)} ({listed(sorted(names[image] for image in group), 3)})"
            for group in best.result.groups[:4]
        )
        given = f"{worst.given} The largest models are of: {described}."
        raise failure("sfm-separate-groups", given, worst.wanted, worst.hint)
    raise worst


def report_warnings(
    attempts: list[Attempt],
    model: SparseModel,
    capture: Capture,
    report: Report,
    features: str = "sift",
) -> None:
    """Warnings about the `model` of the best attempt. features: the setting."""
    best = best_attempt(attempts)
    registered = set(model.names)
    lost = (photo.source for photo in capture.photos if photo.image not in registered)
    missing = list(dict.fromkeys(lost))
    if missing:
        given = len({photo.source for photo in capture.photos})
        report.warn(
            "sfm-photographs-left-out",
            f"{len(missing)} of {given} photographs could not be registered and "
            f"{'is' if len(missing) == 1 else 'are'} not used: {listed(missing)}. More overlap "
            f"with the others would help.{_learned_hint(features)}",
        )
    if any(not registered.issuperset(group) for group in best.result.groups[1:]):
        sizes = ", ".join(str(len(group)) for group in best.result.groups)
        report.warn(
            "sfm-several-models",
            f"The photographs were registered in separate models of {sizes}; the largest is used.",
        )
    if best.passed and attempts[0].failures:
        report.warn(
            "sfm-second-try",
            f"The standard configuration failed ({attempts[0].failures[0].given}) but another one "
            f"passed: {best.configuration.name}. Check the result with care.",
        )
    failed = {found.code for found in best.failures}
    for found in borderline_failures(best.statistics):
        if found.code not in failed:
            hint = found.hint.removesuffix(IF_RIGHT)  # the run goes on without it
            report.warn(found.code, f"{found.given} {found.wanted} {hint}")
    for found in best.failures:
        report.warn(
            found.code, f"Accepted because of --allow-partial: {found.given} {found.wanted}"
        )


def report_joined(
    attempts: list[Attempt], model: SparseModel, capture: Capture, report: Report
) -> None:
    """The metric `registered_by`: how many photographs of the used `model` SIFT registered, and the
    names of those that learned features joined."""
    used = set(model.names)
    joined: set[str] = set()
    if best_attempt(attempts).configuration.learned:
        others = (attempt.result.model for attempt in attempts if not attempt.configuration.learned)
        joined = used - {name for other in others if other is not None for name in other.names}
    names = [photo.name for photo in capture.photos if photo.image in joined]
    report.metric("registered_by", {"sift": len(used) - len(names), "learned": names})


def _learned_hint(features: str) -> str:
    """How learned features may help, where they could have been tried and were not."""
    if features != "auto" or installed():
        return ""
    return f" Learned features may join them: {INSTALL}, then --features learned."


def with_hint(found: SplatError, features: str) -> SplatError:
    """The failure with `_learned_hint`, if learned features may fix it."""
    if found.code not in LEARNED.fixes:
        return found
    return failure(found.code, found.given, found.wanted, found.hint + _learned_hint(features))


def report_metrics(best: Attempt, model: SparseModel, report: Report) -> None:
    """The metrics of the attempt that is used, and of its `model`."""
    report.metric("configuration", best.configuration.name)
    report.metric("keypoints_median", best.keypoints_median)
    for name in ("mean_track_length", "median_triangulation_angle_deg", "baseline_over_depth"):
        report.metric(name, round(getattr(best.statistics, name), 4))
    report.metric("focal_px", [round(float(f), 2) for f in model.camera_params[:, 0]])
    report.metric("distortion", [round(float(k), 5) for k in model.camera_params[:, 3]])
    report.metric("pairs_matched", best.pairs_matched)
    report.metric("pairs_verified", best.pairs_verified)


def attempt_metrics(attempt: Attempt) -> dict[str, Any]:
    """One attempt as JSON values."""
    statistics = {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in asdict(attempt.statistics).items()
    }
    return {
        "configuration": attempt.configuration.name,
        "passed": attempt.passed,
        "failures": [found.code for found in attempt.failures],
        "keypoints_median": attempt.keypoints_median,
        **statistics,
    }
