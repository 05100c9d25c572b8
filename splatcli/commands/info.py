"""`splat info`: statistics and warnings of a splat file or of a run's newest splats."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from splatcli import console
from splatcli.arguments import RunOrFile
from splatcli.folders import load_target
from stages.base import scratch
from stages.base.text import counted
from stages.formats import format_of
from stages.formats.vertical_axis import vertical_warning
from stages.proof.statistics import (
    NEEDLE_ASPECT,
    OUTLIER_BOXES,
    Statistics,
    statistics_of,
)
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.scene import ExportedFile, Splats, parameters_per_splat

_ATTRIBUTES = {
    "means": "positions",
    "quaternions": "rotations",
    "log_scales": "sizes",
    "opacity_logits": "opacities",
    "sh": "colours",
}

_FLOAT32_BYTES = 4


def info(target: RunOrFile = None) -> None:
    """Print statistics of a file or a run: splats, SH degrees, bounds, bytes, and warnings."""
    with scratch.scratch_in(Path(tempfile.gettempdir()), spare=True):
        splats, pipeline = load_target(target, strict=False)
        statistics = statistics_of(splats)
    facts = describe(splats, statistics)
    if pipeline is None and target is not None:
        facts = {**_about_file(target, len(splats)), **facts}
    if pipeline is not None:
        facts = {**_about_run(pipeline), **facts}
    warnings = warnings_of(statistics)
    if pipeline is None and target is not None and (lying := vertical_warning(target)):
        warnings.append(("vertical-axis", lying))
    if console.mode.as_json:
        console.emit("info", **facts, warnings=dict(warnings))
        return
    rows = [(console.label(name), _text(name, value)) for name, value in facts.items()]
    console.table(("", ""), rows)
    for code, sentence in warnings:
        console.warn(f"Warning: {sentence} ({code})")


def describe(splats: Splats, statistics: Statistics) -> dict[str, Any]:
    """Count, SH degrees, bounds of the centres, median size and opacity, and memory."""
    facts: dict[str, Any] = {"splats": statistics.count, "sh_degree": splats.sh_degree}
    if not statistics.count:
        return facts
    facts["splats_by_degree"] = {str(degree): n for degree, n in statistics.by_degree.items()}
    facts["not_finite"] = statistics.count - statistics.whole
    if statistics.whole:
        facts["bounds_low"] = _rounded(statistics.low)
        facts["bounds_high"] = _rounded(statistics.high)
        facts["middle_98_percent_low"] = _rounded(statistics.middle_low)
        facts["middle_98_percent_high"] = _rounded(statistics.middle_high)
        facts["median_centre"] = _rounded(statistics.median_centre)
        facts["median_scale"] = statistics.median_scale
        facts["median_opacity"] = statistics.median_opacity
    drawing = "antialiased" if splats.draw_settings.antialias else "plain"
    facts["drawing"] = drawing
    facts["origin"] = [float(value) for value in splats.origin]
    if splats.place is not None:
        facts["place"] = splats.place.to_json()
    facts["floats_per_splat"] = int(parameters_per_splat(np.array(splats.sh_degree)))
    facts["memory_bytes"] = _FLOAT32_BYTES * facts["floats_per_splat"] * statistics.count
    return facts


def warnings_of(statistics: Statistics) -> list[tuple[str, str]]:
    """(code, sentence) for each kind of defect that is there."""
    warnings = []
    for name, count in statistics.not_finite.items():
        what = f"{{are}} not finite in {{their}} {_ATTRIBUTES[name]}: no viewer can draw {{them}}."
        warnings.append((f"not-finite-{_ATTRIBUTES[name]}", _sentence(count, statistics, what)))
    kinds = {
        "no-rotation": "{are} without a rotation: no viewer can draw {them}.",
        "too-large": "{are} larger than numbers go: no viewer can draw {them}.",
        "transparent": "{are} below an opacity of 1/255, and so never seen.",
        "needles": f"{{are}} over {NEEDLE_ASPECT:g} times as long as wide, like needles.",
        "outliers": f"{{are}} over {OUTLIER_BOXES:g} times as far out as the middle 98 %.",
    }
    for code, what in kinds.items():
        if count := statistics.troubles.get(code, 0):
            warnings.append((code, _sentence(count, statistics, what)))
    return warnings


def _sentence(count: int, statistics: Statistics, what: str) -> str:
    """ "12 splats (0.03 %) are ...". what: the rest, with fields for words that depend on the
    number."""
    words = ("is", "its", "it") if count == 1 else ("are", "their", "them")
    rest = what.format(**dict(zip(("are", "their", "them"), words, strict=True)))
    return f"{counted(count, 'splat')} ({100 * count / statistics.count:.2g} %) {rest}"


def _about_file(path: Path, count: int) -> dict[str, Any]:
    size = format_of(path).size_bytes(path)
    facts: dict[str, Any] = {"file": str(path), "size_bytes": size}
    return facts | ({"bytes_per_splat": round(size / count, 2)} if count else {})


def _about_run(pipeline: Pipeline) -> dict[str, Any]:
    name = results.newest_stage_with_splats(pipeline)
    facts: dict[str, Any] = {"run": str(pipeline.run_folder), "splats_from": name}
    if stale := results.out_of_date(pipeline):
        facts["out_of_date"] = list(stale)
    if pipeline.manifest("sfm") is not None:
        reconstruction = pipeline.load("sfm")
        facts["photographs"] = len(reconstruction.views)
        facts["units"] = reconstruction.units
        facts["levelled"] = bool(reconstruction.levelled)
    manifest = pipeline.manifest("export")
    if manifest is not None:
        assets, proven = pipeline.load("export"), manifest.metrics.get("formats", {})
        facts["assets"] = {
            str(assets.folder / file.path): _size_and_fidelity(file, proven.get(file.format, {}))
            for file in assets.files
        }
    return facts


def _size_and_fidelity(file: ExportedFile, figures: dict[str, Any]) -> dict[str, Any]:
    """figures: of the export, which read the file back and drew it. psnr_db: None if exact."""
    facts: dict[str, Any] = {"size_bytes": file.size_bytes}
    if "verify_db" in figures:
        exact = figures["verify_db"] >= console.EXACT_DB
        facts |= {"psnr_db": None if exact else figures["verify_db"], "exact": exact}
    return facts


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def _text(name: str, value: Any) -> str:
    """A fact as text for the table."""
    if name == "assets":
        return "\n".join(f"{path}: {_asset_text(**facts)}" for path, facts in value.items())
    if isinstance(value, dict):
        return ", ".join(f"{key}: {_text(name, item)}" for key, item in value.items())
    if isinstance(value, list):
        return ",".join(map(str, value))  # as `splat edit` takes coordinates
    return console.figure(name, value)


def _asset_text(size_bytes: int, psnr_db: float | None = None, exact: bool = False) -> str:
    quality = "exact" if exact else console.figure("psnr_db", psnr_db) if psnr_db else ""
    return ", ".join(filter(None, (console.size(size_bytes), quality)))
