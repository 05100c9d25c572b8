"""`splat info`, and the splats that other commands look at: of a run or of a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcli import console
from splatcli.folders import find_run_folder
from stages.run import runfolder
from stages.run.errors import Family, SplatError
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.scene import Splats

_STAGES_WITH_SPLATS = ("quantise", "prune", "train", "seed")


def show_info(target: Path | None, as_json: bool) -> None:
    """Print counts, degrees and bounds of a file or of a run's newest splats."""
    splats, pipeline = load_splats(target)
    facts = describe(splats)
    if pipeline is None and target is not None:
        facts = {"file": str(target), "size": console.size(target.stat().st_size), **facts}
    if pipeline is not None:
        facts = {**_about_run(pipeline), **facts}
    if as_json:
        console.emit("info", **facts)
    else:
        rows = [(console.label(k), console.figure(k, _flat(v))) for k, v in facts.items()]
        console.table(("", ""), rows)


def load_splats(target: Path | None) -> tuple[Splats, Pipeline | None]:
    """(splats, the pipeline if `target` is a run): from a file, or a run's newest stage."""
    if target is not None and target.is_file():
        from stages.formats import read

        return read(target), None
    if target is not None and not target.exists():
        raise SplatError(
            "file-missing",
            given=f"{target} does not exist.",
            wanted="A run folder or a splat file.",
            hint="Check the path.",
        )
    pipeline = Pipeline(find_run_folder(target))
    name = newest_with_splats(pipeline)
    output = pipeline.load(name)
    return (output.splats if name == "quantise" else output), pipeline


def newest_with_splats(pipeline: Pipeline) -> str:
    """The last finished stage whose output is splats. Raises SplatError (no-splats-yet)."""
    for name in _STAGES_WITH_SPLATS:
        if pipeline.manifest(name) is not None:
            return name
    raise SplatError(
        "no-splats-yet",
        given=f"No stage of {pipeline.run_folder} has made splats yet.",
        wanted="A run in which at least `seed` has finished.",
        hint="Run `splat process` to go on.",
        family=Family.USAGE,
    )


def describe(splats: Splats) -> dict[str, Any]:
    """Plain facts: count, SH degrees, bounds of the centres, typical size and opacity."""
    import numpy as np

    facts: dict[str, Any] = {"splats": len(splats), "sh_degree": splats.sh_degree}
    if len(splats) == 0:
        return facts
    degrees, counts = np.unique(splats.sh_degrees, return_counts=True)
    facts["splats_by_degree"] = {str(int(d)): int(n) for d, n in zip(degrees, counts, strict=True)}
    finite = np.isfinite(splats.means).all(axis=1)
    facts["not_finite"] = int((~finite).sum())
    if finite.any():
        low, middle, high = np.percentile(splats.means[finite], (0, 50, 100), axis=0)
        facts["bounds_low"] = _rounded(low)
        facts["bounds_high"] = _rounded(high)
        facts["median_centre"] = _rounded(middle)
        facts["median_scale"] = float(np.exp(np.median(splats.log_scales[finite])))
    facts["median_opacity"] = float(np.median(splats.opacities))
    facts["origin"] = _rounded(splats.origin)
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
        facts["assets"] = {
            str(folder / file.path): console.size(file.size_bytes)
            for file in pipeline.load("export").files
        }
    return facts


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def _flat(value: Any) -> Any:
    if isinstance(value, dict):
        return ", ".join(f"{key}: {item}" for key, item in value.items())
    return " ".join(map(str, value)) if isinstance(value, list) else value


def pipeline_around(file: Path | None) -> Pipeline | None:
    """The run whose export folder a file lies in: its cameras fit the file."""
    if file is None or not runfolder.is_run_folder(file.absolute().parent.parent):
        return None
    return Pipeline(file.absolute().parent.parent)
