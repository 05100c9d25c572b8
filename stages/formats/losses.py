"""What a format cannot hold of some splats, as warnings for the user."""

from __future__ import annotations

from dataclasses import dataclass

from stages.base.lazy import load_object
from stages.base.text import counted
from stages.formats.table import Format
from stages.scene import Splats


@dataclass(frozen=True)
class Loss:
    """One thing that a file lacks: a stable code and a text for the user."""

    code: str
    text: str


def losses_of(row: Format, file_name: str, splats: Splats) -> list[Loss]:
    """What a file of the format `row` cannot hold of `splats`; most files hold everything."""
    found = []
    if row.out_of_range and (count := load_object(row.out_of_range)(splats)):
        found.append(
            Loss(
                "out-of-range",
                f"{file_name} holds positions of 24 bits, and {counted(count, 'splat')} of "
                f"{len(splats):,} lie farther out. These were moved towards the origin and scaled "
                "down. If they are outliers, `splat edit --drop-floaters` removes them; else "
                "write .ply, .glb or .usdz.",
            )
        )
    return found
