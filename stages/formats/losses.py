"""What a format cannot hold of some splats, as warnings for the user."""

from __future__ import annotations

from pathlib import Path

from stages.formats.codecs import CODECS
from stages.formats.format_table import Format
from stages.formats.offset import is_located, offset_path
from stages.formats.values import drop_undrawable
from stages.scene import Splats

ENLARGE = "`splat edit --scale 1000` enlarges a scene; .ply, .glb and .usdz hold all sizes"


def losses_of(row: Format, file_name: str, splats: Splats) -> dict[str, str]:
    """What a file of the format `row` cannot hold of `splats`: texts for the user by the end of
    their stable code. Most files hold everything."""
    found: dict[str, str] = {}
    splats = drop_undrawable(splats)[0]
    if not len(splats):
        return found
    codec = CODECS[row.ending]
    if loss := codec.position_loss(splats):
        advice = "`splat edit --drop-floaters` removes outliers; .ply, .glb and .usdz hold them."
        found["range"] = f"{file_name} {loss}. {advice}"
    if loss := codec.size_loss(splats):
        found["size"] = f"{file_name} {loss}. {ENLARGE}."
    if splats.draw_settings.antialias and not row.drawn_antialiased:
        found["drawing"] = (
            f"{file_name} holds splats for antialiased drawing"
            f"{'' if row.says_drawing else ', of which the file says nothing'}, and most programs "
            f"draw .{row.ending} plainly: splats look too strong there, the more the farther away. "
            "A viewer that compensates opacities (Spark, Brush, PlayCanvas with antialiasing "
            "switched on) draws it right. For others, in the run's folder: "
            f"`splat export run --format {row.ending} --drawing plain`."
        )
    if not row.holds_origin and is_located(splats):
        found["origin"] = (
            f"{file_name} has no field for where the scene lies, which was written to "
            f"{offset_path(Path(file_name)).name}."
        )
    return found
