"""`splat edit`: a sequence of operations on splats, and the effect of each."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console
from splatcli.arguments import ENDINGS, STREAMED, NoClobber
from splatcli.folders import load_target
from splatcli.operation_options import parsed_operations
from stages import formats
from stages.base import scratch
from stages.base.atomic import make_folder
from stages.base.errors import UsageError
from stages.base.text import counted, quoted
from stages.editing import levels, operations
from stages.editing.scene import EditedScene
from stages.editing.syntax import ParsedOperation
from stages.evaluate.evaluation import load_evaluation_views
from stages.formats import format_of, units_of
from stages.formats.replacement import check_target, replacing_asset
from stages.formats.values import drop_undrawable, nothing_drawable
from stages.formats.vertical_axis import vertical_warning
from stages.proof.losses import require_proven
from stages.proof.prover import Prover, cameras_for
from stages.run import results
from stages.scene import split_held_out


def edit(
    ctx: typer.Context,
    source: Annotated[Path, typer.Argument(help="Splat file, or a run folder for its splats.")],
    target: Annotated[
        Path | None,
        typer.Argument(help=f"Splat file to write: {ENDINGS}; {STREAMED} to stream."),
    ] = None,
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the effect of the operations; write nothing.")
    ] = False,
    no_clobber: NoClobber = False,
    **operation_options: Any,
) -> None:
    """Select, move, join and thin out splats: operations in the order in which they are typed.

    Coordinates are those of `splat info`: y down, less the capture's origin. If the splats are a
    run's, or lie in its export folder, the PSNR of the run's photographs is printed for each
    operation, and how much of their pictures is kept.
    """
    if target is None and not dry_run:
        raise UsageError(
            "edit-no-target",
            given=f"splat edit {quoted(source)} names no file to write.",
            wanted="A second file name, or --dry-run.",
            hint=f"splat edit {quoted(source)} edited.ply --keep 'opacity > 0.1'",
        )
    if target is not None and not dry_run:
        check_target(target, no_clobber)
    parsed = parsed_operations(ctx)
    facts = _edit(source, target or Path("scene.ply"), parsed, dry_run)
    if console.mode.as_json:
        console.emit("edited", **facts)
    else:
        _show(facts)


def _edit(
    source: Path, target: Path, parsed: Sequence[ParsedOperation], dry_run: bool
) -> dict[str, Any]:
    """Apply the operations and write `target`. Returns figures: splats, steps, PSNR, bytes."""
    row, prepared = formats.format_of(target), operations.prepare_operations(parsed, target)
    if not dry_run:
        make_folder(target.parent)
    with ExitStack() as stack:
        if target.parent.is_dir():
            stack.enter_context(scratch.scratch_in(target.parent))
        scene, left_out = _load_scene(source, row.drawn_antialiased)
        before, start_db = len(scene.splats), scene.psnr_db()
        facts: dict[str, Any] = {"source": str(source), "splats_before": before}
        steps: list[dict[str, Any]] = []
        warnings = _axis_warning(source, target, parsed)
        for one, edited in operations.apply_operations(scene, prepared):
            steps.append(_report(one, len(scene.splats), edited))
            scene = edited
        facts |= {"splats": len(scene.splats), "units": scene.units, "steps": steps}
        if start_db is not None:
            facts |= {"psnr_before_db": round(start_db, 3), **_quality(scene)}
        if not dry_run:
            _check_place(target, scene)
            unwritten, figures, losses = _written(source, target, scene)
            left_out += unwritten
            facts |= {"splats": len(scene.splats) - unwritten, **figures}
            facts |= {"target": str(target), "size_bytes": row.size_bytes(target)}
            warnings.extend(losses.values())
    if left_out:
        what = counted(left_out, "splat")
        warnings.append(f"Left out, because of values that no viewer can draw: {what}.")
    return facts | {"dropped": left_out, "warnings": warnings}


def _axis_warning(source: Path, target: Path, parsed: Sequence[ParsedOperation]) -> list[str]:
    """What is said of files whose vertical axis is another one, unless the splats are turned."""
    if any(one.name in ("up", "rotate") for one in parsed):
        return []
    merged = [Path(one.value) for one in parsed if one.name == "merge"]
    own = [vertical_warning(source, target)] if source.is_file() else []
    return [*filter(None, [*own, *(vertical_warning(path) for path in merged)])]


def _check_place(target: Path, scene: EditedScene) -> None:
    """Raise SplatError for moved splats in the export folder of a run: all commands take the
    cameras of that run for its files, and these would see them elsewhere."""
    run = results.run_around(target)
    if run is None or not scene.moved:
        return
    raise UsageError(
        "edit-into-run",
        given=f"{target} lies in the export folder of {run.run_folder}, and its splats were moved, "
        "turned or scaled.",
        wanted="A place elsewhere: the cameras of that run do not fit them.",
        hint=f"For example {run.run_folder.parent / target.name}",
    )


def _load_scene(source: Path, antialias: bool) -> tuple[EditedScene, int]:
    """(the splats that can be drawn, with the photographs of their run if there is one; the number
    of others). antialias: whether they may be for antialiased drawing. Raises SplatError."""
    splats, pipeline = load_target(source, strict=False, antialias=antialias)
    pipeline = pipeline or results.run_around(source)
    splats, dropped = drop_undrawable(splats)
    if dropped > len(splats):
        load_target(source, antialias=antialias)  # says which values are not finite
    if dropped and not len(splats):
        raise nothing_drawable(source, dropped)
    if pipeline is None or pipeline.manifest("sfm") is None:
        return EditedScene(splats, units_of(source)), dropped
    capture = results.reconstruction_of(pipeline)
    training, held = split_held_out(capture.views)
    photographs = load_evaluation_views(capture.folder, training, splats.draw_settings)
    evaluation = load_evaluation_views(capture.folder, held, splats.draw_settings) or photographs
    scene = EditedScene(
        *(splats, capture.units, photographs, evaluation, capture.views),
        backend=results.backend_of_run(pipeline),
    )
    return scene, dropped


def _written(
    source: Path, target: Path, scene: EditedScene
) -> tuple[int, dict[str, Any], dict[str, str]]:
    """Write `target` and compare it, read by a second parser, with the splats: (how many cannot be
    drawn, figures, losses). Raises SplatError "edit-verify-failed"."""
    views, (splats, left_out) = scene.placed_views(), drop_undrawable(scene.splats)
    source_format = format_of(source).ending if source.is_file() else ""
    if left_out and not len(splats):
        raise nothing_drawable(target, left_out)
    with replacing_asset(target) as written:
        levels.write(written, splats, units=scene.units, views=views)
        prover = Prover.of(splats, cameras_for(splats, views), scene.backend, source_format)
        return left_out, *require_proven(written, prover, "edit-verify-failed")


def _quality(scene: EditedScene) -> dict[str, float]:
    """The share of the held-out pictures that is kept, where it is not all, and their PSNR, where
    it can be compared."""
    quality: dict[str, float] = {}
    if scene.kept_share < 1:
        quality["pictures_kept"] = round(scene.kept_share, 4)
    if (psnr_db := scene.psnr_db()) is not None:
        quality["psnr_db"] = round(psnr_db, 3)
    return quality


def _quality_text(facts: dict[str, Any]) -> str:
    """`_quality` for the end of a line."""
    text = ""
    if "pictures_kept" in facts:
        text += f", {facts['pictures_kept']:.1%} of the photographs' pictures kept"
    if "psnr_db" in facts:
        text += f", {facts['psnr_db']:.2f} dB on photographs"
    return text


def _report(parsed: ParsedOperation, before: int, scene: EditedScene) -> dict[str, Any]:
    """The effect of an operation, which is printed. before: splats. scene: after it."""
    after = len(scene.splats)
    facts: dict[str, Any] = {"operation": str(parsed), "splats_before": before, "splats": after}
    facts |= _quality(scene)
    if console.mode.as_json:
        console.emit("operation", **facts)
    elif not console.mode.quiet:
        console.note(f"{parsed}: {before:,} -> {counted(after, 'splat')}{_quality_text(facts)}")
    return facts


def _show(facts: dict[str, Any]) -> None:
    for warning in facts["warnings"]:
        console.warn(f"Warning: {warning}")
    result = f"{counted(facts['splats'], 'splat')}, {facts['splats_before']:,} before"
    result += _quality_text(facts)
    if "psnr_db" in facts:
        result += f" ({facts['psnr_db'] - facts['psnr_before_db']:+.2f})"
    if "verify_db" in facts:
        result += f", {console.fidelity(facts['verify_db'])} read back and drawn again"
    if "target" in facts:
        console.note(f"{facts['target']}: {result}, {console.size(facts['size_bytes'])}")
    else:
        console.note(f"Nothing was written. It would be {result}.")
