"""`splat convert`: writes a splat file in another format, and compares the two."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console
from splatcli.arguments import ENDINGS, STREAMED, NoClobber
from stages import formats
from stages.base import scratch
from stages.base.atomic import make_folder
from stages.base.errors import UsageError
from stages.base.text import counted
from stages.editing import levels
from stages.formats import format_of
from stages.formats.replacement import check_target, replacing_asset
from stages.formats.values import nothing_drawable
from stages.formats.vertical_axis import vertical_warning
from stages.proof.losses import require_proven
from stages.proof.prover import Prover, cameras_for
from stages.run import results
from stages.scene import Splats

_STEPS = 3
_UNSEEN_DB = 40.0  # PSNR above which pictures of 8 bits look alike, an error of 1 % of the range


def convert(
    source: Annotated[Path, typer.Argument(help="Splat file to read; its name says the format.")],
    target: Annotated[
        Path,
        typer.Argument(help=f"Splat file to write: {ENDINGS}; {STREAMED} to stream."),
    ],
    *,
    no_clobber: NoClobber = False,
) -> None:
    """Write a splat file in another format.

    The new file is read with a second parser, drawn and compared with the first.
    """
    rows = formats.format_of(source), formats.format_of(target)  # before any work is done
    check_target(target, no_clobber, source)
    begun = time.monotonic()
    # the folder of the target is made once there is something to write
    nearest = next(folder for folder in target.absolute().parents if folder.is_dir())
    with scratch.scratch_in(nearest, spare=True):
        console.step(f"reading {source}", done=0, total=_STEPS)
        splats, dropped = formats.read_drawable(source)
        _refuse_nothing(source, target, splats, dropped)
        console.step(f"writing {target}", done=1, total=_STEPS)
        make_folder(target.parent)
        with replacing_asset(target) as written:
            views = results.views_of(results.run_around(source))
            levels.write(written, splats, units=formats.units_of(source), views=views)
            console.step(f"comparing {target}", done=2, total=_STEPS)
            cameras = cameras_for(splats, views)
            prover = Prover.of(splats, cameras, source_format=rows[0].ending)
            figures, losses = require_proven(written, prover, "convert-verify-failed")
    size = rows[1].size_bytes(target)
    warnings = [*filter(None, [vertical_warning(source, target)]), *losses.values()]
    facts: dict[str, Any] = {
        "source": str(source),
        "target": str(target),
        "splats": len(splats),
        "dropped": dropped,
        "size_bytes": size,
        "bytes_per_splat": round(size / max(1, len(splats)), 2),
        "seconds": round(time.monotonic() - begun, 2),
        **figures,
        "warnings": warnings,
    }
    if console.mode.as_json:
        console.emit("converted", **facts)
        return
    if dropped:
        what = counted(dropped, "splat")
        console.warn(f"Warning: Left out, because of values that no viewer can draw: {what}.")
    for warning in warnings:
        console.warn(f"Warning: {warning}")
    _show(facts, figures)


def _refuse_nothing(source: Path, target: Path, splats: Splats, dropped: int) -> None:
    """Raise SplatError "convert-nothing" where none of the splats can be drawn, and where the new
    file would have no bytes at all."""
    if dropped and not len(splats):
        raise nothing_drawable(source, dropped)
    if format_of(target).ending == "splat" and not len(splats):
        raise UsageError(
            "convert-nothing",
            given=f"{source} holds no splats.",
            wanted="At least one: a .splat without splats has no bytes, and nothing reads it.",
            hint="Write another format: all others have a header.",
        )


def _show(facts: dict[str, Any], figures: dict[str, Any]) -> None:
    size = f"{counted(facts['splats'], 'splat')}, {console.size(facts['size_bytes'])}"
    quality = console.fidelity(figures["verify_db"])
    alike = not facts["warnings"] and console.EXACT_DB > figures["verify_db"] >= _UNSEEN_DB
    seen = ", no difference is seen" if alike else ""
    each = f"{facts['bytes_per_splat']:.1f} bytes each"
    console.note(f"{facts['target']}: {size}, {each}, {quality}{seen}")
    worst = {
        name: figures[name] for name in figures if name.startswith("max_") and figures[name] > 0
    }
    if worst and not console.mode.quiet:
        console.note(f"Largest differences: {console.figures(worst)}", "dim")
