"""`splat info`: what is in a run or a splat file, and what in it may cause trouble."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcli import console
from splatcli.sources import backend_of, newest_with_splats, pipeline_around, splats_of
from splatcli.viewpoints import views_of
from stages.raster.backends import backend_of as chosen_backend
from stages.raster.kernels import cache
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.proof.statistics import Statistics
    from stages.scene import ExportedFile, Splats

_ATTRIBUTES = {
    "means": "positions",
    "quaternions": "rotations",
    "log_scales": "sizes",
    "opacity_logits": "opacities",
    "sh": "colours",
}

_TIMED_FRAMES = 8


def show(target: Path | None, speed: bool, as_json: bool) -> None:
    """Print counts, degrees, bounds, bytes and warnings of a file or of a run's newest splats;
    speed: also how fast they are drawn here.

    Raises SplatError for what cannot be read; values that are not finite are warned of.
    """
    from stages.base import scratch
    from stages.proof.statistics import statistics_of

    with scratch.scratch_in(Path(tempfile.gettempdir()), spare=True):
        splats, pipeline = splats_of(target, strict=False)
        statistics = statistics_of(splats)
    facts = describe(splats, statistics)
    if pipeline is None and target is not None:
        facts = {**_about_file(target, len(splats)), **facts}
    if pipeline is not None:
        facts = {**_about_run(pipeline), **facts}
    if speed and statistics.count:
        facts |= _speed(splats, pipeline or pipeline_around(target))
    warnings = warnings_of(statistics)
    if as_json:
        console.emit("info", **facts, warnings=dict(warnings))
        return
    rows = [(console.label(k), console.figure(k, _flat(v))) for k, v in facts.items()]
    console.table(("", ""), rows)
    for code, sentence in warnings:
        console.note(f"Warning: {sentence} ({code})", "yellow")


def describe(splats: Splats, statistics: Statistics) -> dict[str, Any]:
    """Plain facts: count, SH degrees, bounds of the centres, typical size and opacity."""
    facts: dict[str, Any] = {"splats": statistics.count, "sh_degree": splats.sh_degree}
    if not statistics.count:
        return facts
    facts["splats_by_degree"] = {str(degree): n for degree, n in statistics.by_degree.items()}
    facts["not_finite"] = statistics.count - statistics.whole
    if statistics.whole:
        facts["bounds_low"], facts["bounds_high"] = (
            _rounded(statistics.low),
            _rounded(statistics.high),
        )
        facts["middle_98_percent_low"] = _rounded(statistics.middle_low)
        facts["middle_98_percent_high"] = _rounded(statistics.middle_high)
        facts["median_centre"] = _rounded(statistics.median_centre)
        facts["median_scale"] = statistics.median_scale
        facts["median_opacity"] = statistics.median_opacity
    facts["origin"] = [float(value) for value in splats.origin]
    return facts | _cost(splats)


def _cost(splats: Splats) -> dict[str, Any]:
    """What they take in memory, and the few numbers that explain a splat."""
    from stages.proof.cost import DEGREES, floats_of, mass_within, memory_of

    one, every = (memory_of(splats.sh_degree, count) for count in (1, len(splats)))
    return {
        "floats_per_splat": floats_of(splats.sh_degree),
        "floats_per_splat_by_degree": {str(degree): floats_of(degree) for degree in DEGREES},
        "memory_bytes_per_splat": {
            "float32": one.single,
            "half precision": one.half,
            "while trained": one.trained,
        },
        "memory": {
            "float32": console.size(every.single),
            "half precision": console.size(every.half),
            "while trained": console.size(every.trained),
        },
        "mass_within_sigmas": {str(n): f"{mass_within(n):.1%}" for n in (1, 2, 3)},
    }


def _speed(splats: Splats, pipeline: Pipeline | None) -> dict[str, Any]:
    """Frames a second from the photographs' cameras, at the size that the splats were fitted at;
    around the splats where there are none."""
    from stages.measure.speed import seconds_per_frame

    from stages.scene.framing import orbit_cameras

    if not cache.are_compiled():
        console.note("Compiling the kernels; this is done once and takes about half a minute.")
    views = views_of(pipeline)
    chosen = views[:: max(1, len(views) // _TIMED_FRAMES)][:_TIMED_FRAMES]
    cameras = [splats.draw_settings.camera(v.camera) for v in chosen] or orbit_cameras(
        splats, _TIMED_FRAMES, 0.9
    )
    backend = backend_of(pipeline)
    seconds = seconds_per_frame(splats, cameras, backend)
    return {
        "frames_a_second": round(1 / float(seconds.mean()), 2),
        "frame_size": f"{cameras[0].width} x {cameras[0].height}",
        "frames_timed": len(cameras),
        "drawn_by": chosen_backend(backend).name,
    }


def warnings_of(statistics: Statistics) -> list[tuple[str, str]]:
    """(code, sentence) for each kind of trouble that is there."""
    from stages.proof.statistics import GIANT_PART, NEEDLE_ASPECT, OUTLIER_BOXES

    found = []
    for name, count in statistics.not_finite.items():
        told = f"{_share(count, statistics)} not finite in their {_ATTRIBUTES[name]}"
        found.append((f"not-finite-{_ATTRIBUTES[name]}", f"{told}: no viewer can draw them."))
    kinds = {
        "no-rotation": (statistics.no_rotation, "without a rotation: no viewer can draw them."),
        "too-large": (statistics.too_large, "larger than numbers go: no viewer can draw them."),
        "transparent": (statistics.transparent, "below an opacity of 1/255, and so never seen."),
        "needles": (statistics.needles, f"needles, over {NEEDLE_ASPECT:g} times as long as wide."),
        "giants": (statistics.giants, f"giants, larger than {GIANT_PART:g} of the scene."),
        "outliers": (
            statistics.outliers,
            f"outliers, over {OUTLIER_BOXES:g} times as far out as the middle 98 %.",
        ),
        "duplicates": (statistics.duplicates, "duplicates of others."),
    }
    for code, (count, what) in kinds.items():
        if count:
            found.append((code, f"{_share(count, statistics)} {what}"))
    return found


def _share(count: int, statistics: Statistics) -> str:
    """ "12 splats (0.03 %) are"."""
    return f"{count:,} splats ({100 * count / statistics.count:.2g} %) are"


def _about_file(path: Path, count: int) -> dict[str, Any]:
    from stages.formats import format_of
    from stages.proof.checks import byte_breakdown_of

    size = format_of(path).size_bytes(path)
    facts: dict[str, Any] = {"file": str(path), "size": console.size(size)}
    breakdown = byte_breakdown_of(path)
    if breakdown.unknown:
        facts["bytes_per_splat_unknown"] = breakdown.unknown
    elif count:
        name = "bytes_per_splat_unpacked" if breakdown.unpacked else "bytes_per_splat"
        facts[name] = {what: round(n / count, 2) for what, n in breakdown.parts.items()}
    return facts


def _about_run(pipeline: Pipeline) -> dict[str, Any]:
    name = newest_with_splats(pipeline)
    facts: dict[str, Any] = {"run": str(pipeline.run_folder), "splats_from": name}
    if pipeline.manifest("sfm") is not None:
        reconstruction = pipeline.load("sfm")
        facts["photographs"] = len(reconstruction.views)
        facts["units"] = reconstruction.units
        facts["levelled"] = bool(reconstruction.levelled)
    manifest = pipeline.manifest("export")
    if manifest is not None:
        folder = pipeline.stage_folder("export")
        proven = manifest.metrics.get("formats", {})
        facts["assets"] = {
            str(folder / file.path): _size_and_quality(file, proven.get(file.format, {}))
            for file in pipeline.load("export").files
        }
    return facts


def _size_and_quality(file: ExportedFile, proven: dict[str, Any]) -> str:
    """proven: what export found when it read the file back and drew it."""
    told = [console.size(file.size_bytes)]
    if "verify_db" in proven:
        told.append(console.figure("verify_db", proven["verify_db"]))
    return ", ".join(told)


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def _flat(value: Any) -> Any:
    if isinstance(value, dict):
        return ", ".join(f"{key}: {item}" for key, item in value.items())
    return " ".join(map(str, value)) if isinstance(value, list) else value
