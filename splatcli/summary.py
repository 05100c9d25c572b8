"""What was made, where, how large, how good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.text import Text

from splatcli import console
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline, Step

# The figures worth a line in the final table, by stage; whatever of them a stage reports is shown.
_HEADLINES = {
    "ingest": ("photographs", "left_out"),
    "sfm": (
        *("registered_images", "photographs", "points", "mean_reprojection_error_px"),
        *("pairs_compared", "pairs_matched", "pairs_verified"),
        *("features_seconds", "matching_seconds", "mapping_seconds"),
    ),
    "seed": ("splats",),
    "train": ("splats", "psnr_db", "ssim", "trained_by"),
    # Later stages measure at sizes of their own: their PSNR is no sequel of training's.
    "prune": ("splats", "floaters_removed", "psnr_change_db"),
    "quantise": ("sh_degree", "kept_mib"),
    "export": ("files", "splats"),
}


def show(pipeline: Pipeline, until: str | None, *, quiet: bool, as_json: bool) -> None:
    """The end of a run: a table of stages, and the assets."""
    reached = [stage.name for stage in pipeline.layout.up_to(until)]
    manifests = [m for m in map(pipeline.manifest, reached) if m is not None]
    assets = _assets(pipeline) if "export" in reached else []
    if as_json:
        console.emit("result", **_as_data(pipeline, manifests, assets))
        return
    if quiet:
        for path, _, _ in assets:
            console.out.print(path, markup=False)
        return
    console.out.print()
    rows = [
        (m.stage, console.duration(m.seconds), f"{m.peak_memory_mib:,.0f} MiB", headline(m))
        for m in manifests
    ]
    total_s = sum(m.seconds for m in manifests)
    peak_mib = max((m.peak_memory_mib for m in manifests), default=0.0)
    rows.append(("all", console.duration(total_s), f"{peak_mib:,.0f} MiB", ""))
    console.table(("stage", "time", "peak memory", "result"), rows)
    if assets:
        console.out.print()
        console.columns(
            ("asset", "size", "read back and drawn again, PSNR"),
            [(path, console.size(count), quality) for path, count, quality in assets],
        )
    else:
        console.out.print(Text(f"\nIn {pipeline.stage_folder(reached[-1])}"))


def headline(manifest: Manifest) -> str:
    """The figures of one stage that matter most."""
    names = _HEADLINES.get(manifest.stage, ())
    chosen = {n: manifest.metrics[n] for n in names if n in manifest.metrics}
    if "psnr_db" in chosen:  # always of photographs that training did not see
        chosen = {("held_out_psnr_db" if n == "psnr_db" else n): v for n, v in chosen.items()}
    counts = {n: len(v) if isinstance(v, (list, dict)) else v for n, v in chosen.items()}
    return console.figures(counts)


def _assets(pipeline: Pipeline) -> list[tuple[str, int, str]]:
    """(path, bytes, quality in words) of each exported file."""
    manifest = pipeline.manifest("export")
    if manifest is None:
        return []
    folder = pipeline.stage_folder("export")
    exported = pipeline.load("export")
    return [
        (str(folder / file.path), file.size_bytes, _quality(manifest, file.format))
        for file in exported.files
    ]


def _quality(manifest: Manifest, name: str) -> str:
    """How near pictures of the file are to pictures of the splats before export."""
    if name.startswith("mesh."):
        return _mesh_quality(manifest.metrics.get("mesh", {}))
    figures = manifest.metrics.get("formats", {}).get(name, {})
    return console.figure("verify_db", figures["verify_db"]) if "verify_db" in figures else ""


def _mesh_quality(mesh: dict[str, Any]) -> str:
    """What a mesh is, what it covers, how near it is to the points of the reconstruction."""
    words = [
        f"collision proxy: {mesh.get('triangles', 0):,} triangles",
        f"{mesh.get('covered_share', 0):.0%} of what the photographs show",
    ]
    if mesh.get("sparse_median_distance_share") is not None:
        apart = f"{mesh['sparse_median_distance_share']:.2%} of its size"
        words.append(f"{apart} from the sparse points (median)")
    return ", ".join(words)


def _as_data(
    pipeline: Pipeline, manifests: list[Manifest], assets: list[tuple[str, int, str]]
) -> dict[str, Any]:
    return {
        "run_folder": str(pipeline.run_folder),
        "stages": {
            m.stage: {
                "seconds": m.seconds,
                "peak_memory_mib": m.peak_memory_mib,
                "device": m.device,
                "metrics": m.metrics,
                "warnings": m.warnings,
            }
            for m in manifests
        },
        "assets": [{"path": path, "bytes": count} for path, count, _ in assets],
    }


def show_status(pipeline: Pipeline, steps: list[Step], as_json: bool) -> None:
    """One line a stage: finished, or why it runs (again)."""
    busy = pipeline.busy()
    if as_json:
        rows = [
            {
                "stage": s.stage.name,
                "state": _state(s, busy),
                "reason": s.reason or None,
                "warnings": s.manifest.warnings if s.manifest else [],
            }
            for s in steps
        ]
        console.emit("status", run_folder=str(pipeline.run_folder), busy=busy, stages=rows)
        return
    console.table(
        ("stage", "state", "time", "peak memory", ""),
        [
            (
                f"{s.number}-{s.stage.name}",
                _state(s, busy),
                console.duration(s.manifest.seconds) if s.manifest else "-",
                f"{s.manifest.peak_memory_mib:,.0f} MiB" if s.manifest else "-",
                s.reason or (headline(s.manifest) if s.manifest else ""),
            )
            for s in steps
        ],
        title=str(Path(pipeline.run_folder)),
    )
    if busy:
        console.out.print(f"\nProcess {busy} is working on it now.")


def _state(step: Step, busy: int | None) -> str:
    if busy and step.interrupted:
        return "running"
    if not step.will_run:
        return "finished"
    if step.failed:
        return "failed"
    if step.manifest is not None:
        return "runs again"
    return "interrupted" if step.interrupted else "to do"
