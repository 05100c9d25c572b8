"""A self-contained .html page that shows its splats: from disk, in any browser, without a network.

It holds a viewer and a .ply of the reference trainer, as base64 of gzip in script elements of type
text/plain, so it keeps everything that .ply keeps.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stages.base.atomic import replacing
from stages.base.bad_files import BadFileError
from stages.formats import ply
from stages.formats.inflate import check_size
from stages.page import document
from stages.page.cameras import PageCamera, camera_of, page_cameras
from stages.scene import Camera, Splats, View

_GZIP = 31  # wbits of zlib for the gzip container, whose header then holds no time
_LEVEL = 6
_CHUNK_BYTES = 3 << 20  # of gzip in a script element; a multiple of 3, so that base64 needs no "="
_LINE_LIMIT_BYTES = 2 * _CHUNK_BYTES  # base64 takes 4/3, and the element a little
_END_BYTES = 1 << 10
_INFLATED_AT_ONCE = 1 << 22


@dataclass(frozen=True)
class ClientPage:
    """A page to send to a client: without a panel and without names of files.

    camera: the first view. title: of the page. background: "#rrggbb", behind the splats.
    """

    camera: Camera
    title: str
    background: str = "#000000"


def write(
    path: Path,
    splats: Splats,
    *,
    units: str = "arbitrary",
    views: tuple[View, ...] = (),
    client: ClientPage | None = None,
) -> None:
    """Write `splats`.

    Args:
        views: cameras to look from.
        client: makes a page for a client, with its own camera alone.

    Raises SplatError when the file cannot be written.
    """
    title, source, shots = path.stem, path.name, page_cameras(views, splats)
    if client is not None:
        title, source, shots = client.title, "", (PageCamera(client.title, client.camera),)
    scene = document.scene_data(title, splats, shots, units=units, source=source)
    if client is not None:
        scene |= {"client": True, "background": client.background}
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(document.head(scene).encode("utf-8"))
        for chunk in _chunks(_zipped(ply.file_blocks(splats, units))):
            file.write(document.CHUNK_START.encode("ascii"))
            file.write(base64.b64encode(chunk))
            file.write(document.CHUNK_END.encode("ascii"))
        file.write(document.tail().encode("utf-8"))


def write_beside(
    content: Path, splats: Splats, units: str, views: tuple[View, ...], widths: list[float]
) -> None:
    """Write the page of a streamed asset, which itself holds no splats.

    Args:
        content: the asset's lod-meta.json; the page lies beside it.
        splats: the finest level, to place the cameras.
        units, views: as for `write`.
        widths: width of the splats of each level, see `streamed_sog.splat_widths`.

    Raises SplatError when the file cannot be written.
    """
    scene = document.scene_data(
        content.parent.absolute().name,
        *(splats, page_cameras(views, splats)),
        units=units,
        source=content.name,
        content=content.name,
        levels=widths,
    )
    with replacing(content.with_suffix(".html")) as temporary:
        temporary.write_text(document.head(scene) + document.tail(), encoding="utf-8")


def _zipped(blocks: Iterable[bytes]) -> Iterator[bytes]:
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, _GZIP)
    for block in blocks:
        yield packer.compress(block)
    yield packer.flush()


def _chunks(blocks: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes in chunks of `_CHUNK_BYTES`; the last may be shorter."""
    held = bytearray()
    for block in blocks:
        held += block
        while len(held) >= _CHUNK_BYTES:
            yield bytes(held[:_CHUNK_BYTES])
            del held[:_CHUNK_BYTES]
    if held:
        yield bytes(held)


def read(path: Path) -> Splats:
    """The splats of a page that `write` made. Raises BadFileError."""
    with tempfile.TemporaryDirectory(prefix="splat-") as folder:
        inside = Path(folder) / "inside.ply"
        with inside.open("wb") as file:
            for block in _unzipped(path):
                file.write(block)
        return replace(ply.read(inside), first_camera=_first_camera(path))


def _first_camera(path: Path) -> Camera | None:
    """The first camera of a page; None if it has none. Raises what a damaged page causes."""
    start, end = document.SCENE_START.encode("ascii"), document.CHUNK_END.encode("ascii")
    with path.open("rb") as page:
        while line := page.readline(_LINE_LIMIT_BYTES):
            if line.startswith(start) and line.endswith(end):
                return camera_of(json.loads(line[len(start) : -len(end)])["shots"][0])
    return None


def _unzipped(path: Path) -> Iterator[bytes]:
    """The .ply inside, in blocks; each script element is one line."""
    start, end = (re.escape(t.encode("ascii")) for t in (document.CHUNK_START, document.CHUNK_END))
    wanted = re.compile(start + rb"([A-Za-z0-9+/=]*)" + end)
    unpacker, unpacked = zlib.decompressobj(_GZIP), 0
    with path.open("rb") as page:
        size = page.seek(0, 2)
        page.seek(max(0, size - _END_BYTES))
        if not page.read().rstrip().endswith(document.PAGE_END.strip().encode("ascii")):
            raise BadFileError("the page is incomplete: its end is missing")
        page.seek(0)
        try:
            while line := page.readline(_LINE_LIMIT_BYTES):
                match = wanted.fullmatch(line)
                data = base64.b64decode(match[1], validate=True) if match else b""
                while data:
                    block = unpacker.decompress(data, _INFLATED_AT_ONCE)
                    unpacked += len(block)
                    check_size(unpacked, size)
                    yield block
                    data = unpacker.unconsumed_tail
        except (zlib.error, binascii.Error) as error:
            raise BadFileError(f"the splats in it are damaged ({error})") from error
    if not unpacker.eof:
        raise BadFileError("it holds no splats, or not all of them")
