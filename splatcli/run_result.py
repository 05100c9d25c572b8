"""The result of a run: its stages, and the exported files with their sizes and qualities."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

from rich.text import Text

from splatcli import console, progress
from stages.base.text import counted, listed, quoted
from stages.evaluate.verdict import GOOD, UNKNOWN, USABLE, WRONG
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline
from stages.train.settings import STEPS_PER_VIEW

# The metrics in the tables of `process` and `status`, by stage; those of `show_quality` apart.
_HEADLINES = {
    "ingest": ("photographs", "left_out"),
    "sfm": ("registered_images", "points", "mean_reprojection_error_px"),
    "seed": ("splats",),
    "train": ("steps", "side_px", "splats", "trained_by"),
    # Later stages measure at sizes of their own: it cannot be compared with that of training.
    "prune": ("splats", "floaters_removed", "psnr_change_db"),
    "quantise": ("sh_degree", "kept_mib", "plain_drawing_change_db"),
    "export": ("files", "splats"),
}
_SMALLER = {"mean at half size": "psnr_half_db", "mean at quarter size": "psnr_quarter_db"}
_SCALE = """To an eye: 20 dB is blurred, 25 dB is softer, 30 dB is close to the photograph.
More of PSNR and SSIM: docs/guide/captures.md#psnr-and-ssim"""
# With so few views more steps for each fit these photographs and no others
# (docs/experiments/densification.md#longer-and-shorter-runs).
_FEW_VIEWS = 25
_MORE_STEPS = "With so few views\nmore steps give less than 0.1 dB in the mean. "
_STYLES = {GOOD: "green", USABLE: "yellow", WRONG: "red", UNKNOWN: ""}


def show(pipeline: Pipeline, until: str | None) -> None:
    """Print a table of the stages up to `until`, the exported files, after all stages their
    warnings again, and last the verdict on what was trained."""
    reached = [stage.name for stage in pipeline.layout.up_to(until)]
    manifests = [m for m in map(pipeline.manifest, reached) if m is not None]
    assets = _assets(pipeline) if "export" in reached else []
    verdict = _verdict(manifests)
    if console.mode.as_json:
        console.emit("result", **_as_data(pipeline, manifests, assets))
        return
    if console.mode.quiet:
        for path, _, _ in assets:
            console.out.print(path, markup=False)
        if verdict.get("grade") == WRONG:
            console.note(verdict["text"])
        return
    console.out.print()
    rows = [(m.stage, time_of(m), memory(m.peak_memory_mib), headline(m)) for m in manifests]
    total_s = sum(m.seconds for m in manifests)
    peak_mib = max((m.peak_memory_mib for m in manifests), default=0.0)
    rows.append(("all", console.duration(total_s), memory(peak_mib), ""))
    console.table(("stage", "time", "peak memory", "result"), rows)
    by_stage = {manifest.stage: manifest for manifest in manifests}
    if training := by_stage.get("train"):
        show_choice(training)
        show_quality(training, by_stage.get("prune"))
    if assets:
        console.out.print()
        console.columns(
            ("asset", "size", "PSNR when read back"),
            [(path, console.size(count), quality) for path, count, quality in assets],
        )
    else:
        console.out.print(Text(f"\nIn {pipeline.stage_folder(reached[-1])}"))
    warnings = sum(len(manifest.warnings) for manifest in manifests)
    if until is None and warnings:
        console.note(f"\n{counted(warnings, 'warning')}, of all stages:")
        for manifest in manifests:
            progress.warn(manifest)
    if verdict:
        console.out.print()
        console.paragraph(console.out, styled(verdict))
        run = quoted(pipeline.run_folder)
        console.out.print(f"Look at it: splat view {run}", markup=False)
        if until is None and verdict["grade"] in (GOOD, USABLE) and _would_gain(by_stage):
            free = quoted(_free_name_beside(pipeline.run_folder))
            command = f"splat process {run} --out {free} --no-hold-out"
            console.out.print(f"Train on all photographs: {command}", markup=False)


def _free_name_beside(run_folder: Path) -> Path:
    """A folder that does not exist, so that the command continues no earlier run."""
    whole = run_folder if run_folder.name not in ("", "..") else run_folder.resolve()
    names = chain(["final"], (f"final-{number}" for number in count(2)))
    places = (whole.with_name(f"{whole.name}-{name}") for name in names)
    return next(place for place in places if not os.path.lexists(place))


def _would_gain(by_stage: Mapping[str, Manifest]) -> bool:
    """Whether the run holds photographs out that are no test photographs of a file, and has so few
    that a training on all is better (docs/experiments/evaluation.md)."""
    settings, training = by_stage["sfm"].settings, by_stage["train"].metrics
    held_out = settings.get("hold_out") and not settings.get("split")
    return bool(held_out) and 0 < training.get("training_views", 0) <= _FEW_VIEWS


def styled(verdict: Mapping[str, str]) -> Text:
    """The sentence of a verdict in the colour of its grade."""
    return Text(verdict["text"], style=_STYLES[verdict["grade"]])


def _verdict(manifests: Sequence[Manifest]) -> dict[str, str]:
    """The grade and the sentence; empty before training."""
    by_stage = {manifest.stage: manifest.metrics for manifest in manifests}
    if "verdict" not in by_stage.get("train", {}):
        return {}
    found: dict[str, str] = dict(by_stage["train"]["verdict"])
    lost = by_stage.get("sfm", {}).get("unregistered_images", [])
    if lost:
        are = "photograph is" if len(lost) == 1 else "photographs are"
        found["text"] += f" {len(lost)} {are} left out: {listed(lost, 3)}."
    return found


def memory(mib: float) -> str:
    """Peak memory as people read it."""
    return console.size(mib * 2**20)


def time_of(manifest: Manifest) -> str:
    """How long a stage took."""
    return console.times(manifest.seconds, manifest.cpu_seconds)


def headline(manifest: Manifest) -> str:
    """The most important metrics of one stage."""
    names = _HEADLINES.get(manifest.stage, ())
    chosen = {n: manifest.metrics[n] for n in names if n in manifest.metrics}
    counts = {n: len(v) if isinstance(v, (list, dict)) else v for n, v in chosen.items()}
    return console.figures(counts)


def show_choice(training: Manifest) -> None:
    """Print what the number of training views decided: nothing where --steps, --seconds or
    --splats did."""
    metrics, settings = training.metrics, training.settings
    given = any(settings.get(name) for name in ("steps", "seconds", "splats"))
    if given or "splat_cap" not in metrics:
        return
    views = metrics["training_views"]
    enough = metrics["steps"] >= STEPS_PER_VIEW * views and views <= _FEW_VIEWS
    console.out.print(
        f"\nChosen for {counted(views, 'training view')}: {metrics['steps']:,} steps at "
        f"{metrics['side_px']} px,\nand {metrics['splats']:,} of at most "
        f"{metrics['splat_cap']:,} splats. {_MORE_STEPS if enough else ''}What more would give:\n"
        "docs/guide/presets.md#what-more-would-give-in-your-scene",
        markup=False,
    )


def show_quality(training: Manifest, pruning: Manifest | None = None) -> None:
    """Print PSNR and SSIM of held-out photographs after training, and what they mean; nothing
    without such metrics. pruning: the run's; its change of the mean is printed, too."""
    metrics = training.metrics
    if "psnr_db" not in metrics:
        return
    worst = f"worst: {metrics.get('psnr_worst_view')}"
    names = {"mean": "psnr_db", **_SMALLER, worst: "psnr_worst_db"}
    rows = [
        (name, console.figure(key, metrics[key]), str(metrics.get("ssim", "")) if i == 0 else "")
        for i, (name, key) in enumerate(names.items())
        if key in metrics
    ]
    change = pruning.metrics.get("psnr_change_db") if pruning else None
    if change is not None:
        pruned = round(metrics["psnr_db"] + change, 2)
        rows.append(("mean after pruning", console.figure("psnr_db", pruned), ""))
    console.out.print()
    console.table(("held-out photographs", "PSNR", "SSIM"), rows)
    console.out.print(_SCALE)


def _assets(pipeline: Pipeline) -> list[tuple[str, int, str]]:
    """(path, bytes, quality as text) of each exported file."""
    manifest = pipeline.manifest("export")
    if manifest is None:
        return []
    assets = pipeline.load("export")
    return [
        (str(assets.folder / file.path), file.size_bytes, _quality(manifest, file.format))
        for file in assets.files
    ]


def _quality(manifest: Manifest, name: str) -> str:
    """PSNR between pictures of the file and of the splats before export."""
    if name.startswith("mesh."):
        return _mesh_quality(manifest.metrics.get("mesh", {}))
    figures = manifest.metrics.get("formats", {}).get(name, {})
    return console.fidelity(figures["verify_db"]) if "verify_db" in figures else ""


def _mesh_quality(mesh: dict[str, Any]) -> str:
    """Triangles and coverage."""
    return (
        f"collision proxy: {mesh.get('triangles', 0):,} triangles, "
        f"{mesh.get('covered_share', 0):.0%} of what the photographs show"
    )


def _as_data(
    pipeline: Pipeline, manifests: list[Manifest], assets: list[tuple[str, int, str]]
) -> dict[str, Any]:
    return {
        "run_folder": str(pipeline.run_folder),
        "stages": {m.stage: {**progress.result_of(m), "device": m.device} for m in manifests},
        "verdict": _verdict(manifests),
        "assets": [{"path": path, "size_bytes": count} for path, count, _ in assets],
    }
