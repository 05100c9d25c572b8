"""The files that `splat view` serves: the page, the splats, the photographs."""

from __future__ import annotations

import mimetypes
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stages.formats import format_of, streamed_sog
from stages.page import document
from stages.page.cameras import PageCamera, page_cameras
from stages.scene import Splats, View
from stages.viewer.server import Item


def site(
    title: str,
    splats: Splats,
    content: Path,
    views: Sequence[View] = (),
    photos: Path | None = None,
    units: str = "arbitrary",
    source: str = "",
) -> dict[str, Item]:
    """The items to serve, by address.

    Args:
        content: the splats as .ply, or the lod-meta.json of a streamed asset.
        photos: the folder that `View.image` is relative to; missing photographs are left out.
        source: the path shown as the input of `splat edit`; by default `content`.

    Raises SplatError.
    """
    shots, items = with_photographs(page_cameras(views, splats), views, photos)
    streams = format_of(content).streamed
    files = streamed_sog.parts_of(content) if streams else {"scene.ply": content}
    items |= {f"/{name}": Item(file, "application/octet-stream") for name, file in files.items()}
    levels = streamed_sog.splat_widths(content, splats) if streams else []
    scene = document.scene_data(
        title,
        splats,
        shots,
        units=units,
        source=source or str(content),
        content=next(iter(files)),
        levels=levels,
    )
    page = document.head(scene) + document.tail()
    items["/"] = Item(page.encode("utf-8"), "text/html; charset=utf-8")
    return items


def with_photographs(
    shots: Sequence[PageCamera], views: Sequence[View], photos: Path | None
) -> tuple[list[PageCamera], dict[str, Item]]:
    """(the shots with the addresses of their photographs, the items by address)."""
    images = {view.name: view.image for view in views}
    shown, items = [], {}
    for number, shot in enumerate(shots):
        file = _inside(photos, images.get(shot.name, ""))
        if file is not None:
            # Numbered addresses: the names of photographs may hold any character.
            address = f"photos/{number}{file.suffix.lower()}"
            kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            items[f"/{address}"] = Item(file, kind)
            shot = replace(shot, photo=address)
        shown.append(shot)
    return shown, items


def _inside(folder: Path | None, name: str) -> Path | None:
    """The file of that name if it lies in the folder: a damaged list of photographs must not
    publish another file."""
    if folder is None or not name:
        return None
    file = (folder / name).resolve()
    return file if file.is_relative_to(folder.resolve()) and file.is_file() else None
