"""What is damaged: each format as it lies on disk, and what is packed inside it.

A changed byte inside gzip or zip is found by a check sum: there the content is changed before it
is packed again, as somebody would who means harm.
"""

from __future__ import annotations

import base64
import functools
import gzip
import io
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stages import formats
from tests.formats.truth import many_splats

SPLATS = 40


@dataclass(frozen=True)
class Layer:
    """content: of a whole file, or of what is inside it. pack: makes the file again.
    beside: other files of the same folder, by name. text: whether words can be changed.
    share: of the inputs that others get, where each takes a process."""

    ending: str
    content: Callable[[], bytes]
    pack: Callable[[bytes], bytes] = bytes
    beside: Callable[[], dict[str, bytes]] = dict
    text: bool = False
    share: float = 1.0


@functools.cache
def files(ending: str) -> dict[str, bytes]:
    """What our writer leaves: a.`ending`, and a.bin beside a .gltf."""
    with tempfile.TemporaryDirectory() as folder:
        formats.write(Path(folder) / f"a.{ending}", many_splats(SPLATS))
        return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def _whole(ending: str) -> Callable[[], bytes]:
    return lambda: files(ending)[f"a.{ending}"]


def _ascii_ply() -> bytes:
    from plyfile import PlyData

    data = PlyData.read(io.BytesIO(files("ply")["a.ply"]))
    data.text = True
    out = io.BytesIO()
    data.write(out)
    return out.getvalue()


def _glb_json() -> bytes:
    content = files("glb")["a.glb"]
    return content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]


def _glb_with(text: bytes) -> bytes:
    whole = files("glb")["a.glb"]
    body = whole[20 + struct.unpack_from("<I", whole, 12)[0] :]
    text += b" " * (-len(text) % 4)
    size = 20 + len(text) + len(body)
    return struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON") + text + body


def _zipped_part(ending: str, name: str) -> bytes:
    with zipfile.ZipFile(io.BytesIO(files(ending)[f"a.{ending}"])) as package:
        return package.read(name)


def _zip_with(ending: str, name: str, new: bytes) -> bytes:
    file = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(files(ending)[f"a.{ending}"])) as old,
        zipfile.ZipFile(file, "w") as package,
    ):
        for part in old.namelist():
            package.writestr(part, new if part == name else old.read(part))
    return file.getvalue()


_CHUNK = re.compile(rb'(<script[^>]*class="splats"[^>]*>)([A-Za-z0-9+/=]*)(</script>)')


def _html_parts() -> tuple[bytes, bytes, bytes]:
    """(the viewer before the splats, the splats, the viewer after them): megabytes of it, in which
    damage meets no reader of ours."""
    page = files("html")["a.html"]
    match = _CHUNK.search(page)
    assert match is not None
    return page[: match.start()], page[match.start() : match.end()], page[match.end() :]


def _html_around(splats: bytes) -> bytes:
    before, _, after = _html_parts()
    return before + splats + after


def _html_inside() -> bytes:
    chunks = _CHUNK.findall(files("html")["a.html"])
    return gzip.decompress(b"".join(base64.b64decode(chunk[1]) for chunk in chunks))


def _html_with(inside: bytes) -> bytes:
    opening, _, closing = _CHUNK.findall(_html_parts()[1])[0]
    return _html_around(opening + base64.b64encode(gzip.compress(inside, 1)) + closing)


def _part(ending: str, name: str, *, text: bool) -> Layer:
    return Layer(
        ending,
        lambda: _zipped_part(ending, name),
        lambda new: _zip_with(ending, name, new),
        text=text,
    )


LAYERS = {
    "ply": Layer("ply", _whole("ply")),
    "ply, header and words": Layer("ply", _whole("ply"), text=True),
    "ply, ascii": Layer("ply", _ascii_ply, text=True),
    "splat": Layer("splat", _whole("splat")),
    "compressed.ply": Layer("compressed.ply", _whole("compressed.ply")),
    "spz": Layer("spz", _whole("spz")),
    "spz, unpacked": Layer(
        "spz",
        lambda: gzip.decompress(files("spz")["a.spz"]),
        lambda inside: gzip.compress(inside, 1),
    ),
    "sog": Layer("sog", _whole("sog")),
    "sog, meta.json": _part("sog", "meta.json", text=True),
    "sog, a picture": _part("sog", "means_l.webp", text=False),
    "glb": Layer("glb", _whole("glb")),
    "glb, document": Layer("glb", _glb_json, _glb_with, text=True),
    "gltf": Layer(
        "gltf", _whole("gltf"), beside=lambda: {"a.bin": files("gltf")["a.bin"]}, text=True
    ),
    "html": Layer("html", lambda: _html_parts()[1], _html_around, text=True),
    "html, unpacked": Layer("html", _html_inside, _html_with, text=True),
    "usda": Layer("usda", _whole("usda"), text=True, share=0.05),
    "usdc": Layer("usdc", _whole("usdc"), share=0.05),
    "usdz": Layer("usdz", _whole("usdz"), share=0.05),
}
