"""Levels of detail of one scene: each has a quarter of the splats of the level before it."""

from __future__ import annotations

from pathlib import Path

from stages import formats
from stages.editing.decimate import FAR_ROUND_SHARE, decimate
from stages.formats.values import drop_undrawable
from stages.scene import Splats, View

# On a surface a quarter of the splats are twice as large, and look as large twice as far away.
LEVEL_RATIO = 4
_FEWEST = 20_000  # a level of so few splats is small enough to be loaded first


def coarser_levels(splats: Splats) -> list[Splats]:
    """The levels of detail below `splats`, finest first. Every splat must be drawable."""
    levels = [splats]
    while len(levels[-1]) > _FEWEST:
        levels.append(decimate(levels[-1], len(levels[-1]) // LEVEL_RATIO, FAR_ROUND_SHARE))
    return levels[1:]


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", views: tuple[View, ...] = ()
) -> int:
    """As `formats.write`, with levels of detail where the format holds them."""
    streamed = formats.format_of(path).streamed
    coarser = coarser_levels(drop_undrawable(splats)[0]) if streamed else ()
    return formats.write(path, splats, units=units, views=views, coarser=coarser)
