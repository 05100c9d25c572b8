"""Decides whether masks and depth maps are upright or lie as the stored pixels of photographs do.

The EXIF orientation turns a photograph. Programs that ignore it make maps of the stored pixels. The
proportions of a map tell which it is where the photograph is turned by a quarter. One program makes
all masks of a capture, and one all depth maps, so such maps decide for those that do not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from stages.ingest import depth_files, masking
from stages.ingest.decode import Unusable, head, readers_set_up
from stages.ingest.sources import Findings

Size = tuple[int, int]


def with_turns(files: Findings) -> tuple[Findings, list[str]]:
    """Decide for all masks and for all depth maps.

    Returns:
        The findings with that, and the names of turned photographs whose maps are taken as upright
        because nothing tells.
    """
    depth_maps = {name: file.path for name, file in files.depths.items()}
    turned: dict[str, tuple[Size, int]] = {}
    with readers_set_up():
        for source in files.sources:
            if source.name in files.masks or source.name in depth_maps:
                stored, orientation = _head(source.path)
                if orientation != 1:
                    turned[source.name] = stored, orientation
        masks_stored, unknown = _decide(turned, files.masks, masking.size_of)
        depths_stored, more = _decide(turned, depth_maps, depth_files.size_of)
    decided = replace(files, masks_as_stored=masks_stored, depths_as_stored=depths_stored)
    return decided, [source.name for source in files.sources if source.name in unknown | more]


def _head(path: Path) -> tuple[Size, int]:
    """See `head`; orientation 1 for a file that cannot be read, which is left out later."""
    try:
        return head(path)
    except Unusable:
        return (0, 0), 1


def _decide(
    turned: Mapping[str, tuple[Size, int]],
    maps: Mapping[str, Path],
    size_of: Callable[[Path], Size | None],
) -> tuple[bool, set[str]]:
    """(whether the maps lie as stored, the photographs for which that is unknown).

    Args:
        turned: stored size and EXIF orientation of the photographs with another than 1.
        maps: of all photographs.
        size_of: the size of a map; None if it cannot be read.
    """
    kind_of: dict[str, bool | None] = {}
    for name, (stored, orientation) in turned.items():
        size = size_of(maps[name]) if name in maps else None
        if size is not None:
            upright = stored[::-1] if orientation >= 5 else stored
            as_stored = masking.same_aspect(size, stored)
            kind_of[name] = as_stored if as_stored != masking.same_aspect(size, upright) else None
    kinds = set(kind_of.values()) - {None}
    unknown = {name for name, kind in kind_of.items() if kind is None}
    return kinds == {True}, set() if len(kinds) == 1 else unknown
