"""What a file lost of the splats that it was made from, as warnings for the user.

The changes are those that the proof of the file measured; the properties of the format explain
them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.base.text import counted
from stages.formats import Format, format_of
from stages.formats.codecs import CODECS
from stages.formats.compressed_ply import outlier_shells
from stages.formats.offset import is_located, offset_path
from stages.page.sizes import blurred
from stages.proof.compare import Change
from stages.proof.prover import DROP_OUTLIERS, Proof, Prover
from stages.scene import Splats

_ROUNDINGS = 4  # of float32, on the way to a file and back
_WHOLE = ".ply, .glb and .usdz hold them"


def require_proven(path: Path, prover: Prover, code: str) -> tuple[dict[str, Any], dict[str, str]]:
    """(the figures of the proof of a file that was just written, `losses_of` it). Raises SplatError
    `code` if it is wrong."""
    proof = prover.require(path, code)
    losses = losses_of(path, prover.splats, proof)
    if "drawing" not in losses:
        return proof.figures, losses
    plain_db = round(prover.plain_drawing_db(), 2)
    losses["drawing"] += f" Drawn plainly, its pictures have a PSNR of {plain_db} dB."
    return proof.figures | {"plain_drawing_db": plain_db}, losses


def losses_of(path: Path, splats: Splats, proof: Proof) -> dict[str, str]:
    """`changes_shown`, and what the file has no field for, by the end of a stable code."""
    row, name, losses = format_of(path), path.name, changes_shown(path, splats, proof)
    if not len(splats):
        return losses
    if splats.draw_settings.antialias and not row.drawn_antialiased:
        losses["drawing"] = (
            f"{name} holds splats for antialiased drawing"
            f"{'' if row.says_drawing else ', of which the file says nothing'}, and most programs "
            f"draw .{row.ending} plainly: splats look too strong there, the more the farther away. "
            "A viewer that compensates opacities (Spark, Brush, PlayCanvas with antialiasing "
            "switched on) draws it right. For others, in the run's folder: "
            f"`splat export --format {row.ending} --drawing plain`."
        )
    if not row.holds_origin and is_located(splats):
        losses["origin"] = (
            f"{name} has no field for where the scene lies, which was written to "
            f"{offset_path(path).name}."
        )
    if row.ending == "html" and (text := blurred(splats)):
        losses["blurred"] = text
    if row.on_globe and splats.place is None:
        losses["place"] = (
            f"{name} has no place on the earth: globes show it at their centre, unless their "
            "program places it (`modelMatrix` of CesiumJS)."
        )
    return losses


def changes_shown(path: Path, splats: Splats, proof: Proof) -> dict[str, str]:
    """What changed visibly of the drawable `splats` in the file at `path`, by the end of a stable
    code: how much, why, and what to do. Most files hold everything."""
    row, name = format_of(path), path.name
    losses: dict[str, str] = {}
    for attribute, (code, text) in _CHANGES.items():
        if change := proof.changes.get(attribute):
            count = f"{change.count:,} of {counted(len(splats), 'splat')}"
            losses[code] = f"In {name} {count} {text(row, splats, change)}."
    if proof.loss_db is not None and not losses:
        why = f"the format {row.loses}" if row.loses else "the original had lost more already"
        losses["lossy"] = (
            f"Pictures of {name} have a PSNR of {proof.loss_db:.1f} dB: {why}. Where a viewer "
            "reads them, prefer .ply, .glb or .usdz."
        )
    return losses


def _moved(row: Format, splats: Splats, change: Change) -> str:
    farthest = np.abs(splats.means + splats.origin).max(initial=0.0)
    if not row.loses and change.largest > _ROUNDINGS * float(np.spacing(np.float32(farthest))):
        return f"lie elsewhere, by up to {change.largest:.3g} units, which is no rounding"
    outliers = int(np.count_nonzero(outlier_shells(splats.means)))
    far = f", and {counted(outliers, 'outlier')} widened it" if outliers else ""
    return (
        f"moved, by up to {change.largest:.3g} units: the format {CODECS[row.ending].positions}"
        f"{far}. {DROP_OUTLIERS}; {_WHOLE}"
    )


def _resized(row: Format, splats: Splats, change: Change) -> str:
    why, advice = CODECS[row.ending].size_loss(splats)
    return (
        f"have another size, by a factor of up to {change.largest:.3g}: the format "
        f"{why or row.loses}. {advice + '; ' if advice else ''}{_WHOLE}"
    )


def _recoloured(row: Format, splats: Splats, change: Change) -> str:
    most = CODECS[row.ending].most_sh
    clipped = bool(np.abs(splats.sh[:, 1:]).max(initial=0.0) > most)
    why = f"holds coefficients of view-dependent colour up to {most:g}" if clipped else row.loses
    return (
        f"have another colour, by up to {change.largest:.3g} where 1 is white: the format {why}. "
        f"`splat edit --degree 0` removes view-dependent colour; {_WHOLE}"
    )


_CHANGES = {
    "position": ("range", _moved),
    "size": ("size", _resized),
    "colour": ("colour", _recoloured),
}
