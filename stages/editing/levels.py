"""Levels of detail of one scene, each a quarter of the splats of the one before it; and a page."""

from __future__ import annotations

from pathlib import Path

from stages.editing.decimate import FAR_ROUND_SHARE, decimate
from stages.formats import html, streamed_sog
from stages.formats.values import drop_undrawable
from stages.scene import Splats, View

# On a surface a quarter of the splats are twice as large, and look as large twice as far away.
A_LEVEL = 4
_FEWEST = 20_000  # a level of so few is small enough to begin with


def levels_of(splats: Splats) -> list[Splats]:
    """The finest first. Every splat must be drawable."""
    found = [splats]
    while len(found[-1]) > _FEWEST:
        found.append(decimate(found[-1], len(found[-1]) // A_LEVEL, FAR_ROUND_SHARE))
    return found


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", views: tuple[View, ...] = ()
) -> int:
    """Write `splats` and coarser levels of them as a streamed SOG, and beside it a page that shows
    it on any web server; return how many could not be drawn and were left out.

    views: cameras to look from. Raises SplatError when it cannot be written.
    """
    kept, dropped = drop_undrawable(splats)
    streamed_sog.write_levels(Path(path), levels_of(kept), units)
    html.write_beside(Path(path), kept, units, views)
    return dropped
