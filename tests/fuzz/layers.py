"""What is damaged: each format as it lies on disk, and what is packed inside it.

A changed byte inside gzip or zip is found by a check sum: there the content is changed before it
is packed again, as somebody would who means harm.
"""

from __future__ import annotations

import base64
import functools
import gzip
import io
import itertools
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard

from stages import formats
from stages.formats import usd_read
from stages.scene import load_splats
from tests.formats.truth import many_splats
from tests.fuzz import camera_layers, photo_layers, run_layers
from tests.fuzz.layer import SPLATS, Layer, checked

_KSPLAT = Path(__file__).parents[1] / "formats" / "ksplat"
_SPZ_4 = Path(__file__).parents[1] / "formats" / "spz4" / "adobe_degree_3.spz"


@functools.cache
def files(ending: str) -> dict[str, bytes]:
    """What our writer leaves: a.`ending`, and what belongs to it."""
    with tempfile.TemporaryDirectory() as folder:
        formats.write(Path(folder) / f"a.{ending}", many_splats(SPLATS))
        return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


@functools.cache
def _streamed(name: str) -> dict[str, bytes]:
    """An asset of this name and its chunks."""
    with tempfile.TemporaryDirectory() as folder:
        formats.write(Path(folder) / name, many_splats(SPLATS))
        every = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in every}


def _streamed_layer(name: str) -> Layer:
    def beside() -> dict[str, bytes]:
        return {other: content for other, content in _streamed(name).items() if other != name}

    return Layer(name, lambda: _streamed(name)[name], beside=beside, text=True)


def _whole(ending: str) -> Callable[[], bytes]:
    return lambda: files(ending)[f"a.{ending}"]


def _ascii_ply() -> bytes:
    from plyfile import PlyData

    data = PlyData.read(io.BytesIO(files("ply")["a.ply"]))
    data.text = True
    out = io.BytesIO()
    data.write(out)
    return out.getvalue()


def _glb_json(ending: str) -> bytes:
    content = files(ending)[f"a.{ending}"]
    return content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]


def _glb_with(ending: str, text: bytes) -> bytes:
    whole = files(ending)[f"a.{ending}"]
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


@functools.cache
def _html_parts() -> tuple[bytes, bytes, bytes]:
    """(the first line of the page, the splats, the end of the page). The viewer between them, in
    which damage meets no reader of ours, is left out: it has megabytes."""
    page = files("html")["a.html"]
    match = _CHUNK.search(page)
    assert match is not None
    head, end = page[: page.index(b"\n") + 1], page[match.end() :]
    return head, page[match.start() : match.end()], end[:1] + end[-1000:]


def _html_around(splats: bytes) -> bytes:
    before, _, after = _html_parts()
    return before + splats + after


def _html_inside() -> bytes:
    chunks = _CHUNK.findall(files("html")["a.html"])
    return gzip.decompress(b"".join(base64.b64decode(chunk[1]) for chunk in chunks))


def _html_with(inside: bytes) -> bytes:
    opening, _, closing = _CHUNK.findall(_html_parts()[1])[0]
    return _html_around(opening + base64.b64encode(gzip.compress(inside, 1)) + closing)


def _glb_document(ending: str) -> Layer:
    return Layer(
        f"a.{ending}",
        lambda: _glb_json(ending),
        lambda new: _glb_with(ending, new),
        text=True,
    )


def _spz_4() -> tuple[bytes, list[bytes]]:
    """(header, arrays) of a file with one zstd frame an array."""
    whole = _SPZ_4.read_bytes()
    count, (starts,) = whole[15], struct.unpack_from("<I", whole, 16)
    packed = [size for size, _ in struct.iter_unpack("<QQ", whole[starts : starts + 16 * count])]
    ends = starts + 16 * count + np.cumsum(packed)
    unpack = zstandard.ZstdDecompressor().decompress
    return whole[:32], [unpack(whole[e - n : e]) for n, e in zip(packed, ends, strict=True)]


def _spz_4_with(content: bytes) -> bytes:
    """The file of a header and arrays that may have become longer or shorter."""
    arrays = _spz_4()[1]
    cuts = [32, *(32 + np.cumsum([len(array) for array in arrays[:-1]])), None]
    parts = [content[start:end] for start, end in itertools.pairwise(cuts)]
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    sizes = [struct.pack("<QQ", len(b), len(a)) for a, b in zip(parts, packed, strict=True)]
    return b"".join([content[:32], *sizes, *packed])


def _part(ending: str, name: str, *, text: bool) -> Layer:
    return Layer(
        f"a.{ending}",
        lambda: _zipped_part(ending, name),
        lambda new: _zip_with(ending, name, new),
        text=text,
    )


def _on_disk(ending: str) -> Layer:
    """A file of the format as it is, beside what belongs to it."""
    name = f"a.{ending}"

    def beside() -> dict[str, bytes]:
        return {other: content for other, content in files(ending).items() if other != name}

    if ending in _USD:
        return Layer(name, _whole(ending), text=ending in _WORDS, read=_read_usd, in_fork=True)
    return Layer(name, _whole(ending), beside=beside, text=ending in _WORDS)


def _read_usd(path: Path) -> int:
    """The exit status of what `usd_read.read` starts, which begins with `main`."""
    output = path.with_name("splats.bin")
    status = usd_read.main([str(path), str(output)])
    if status == 0:
        checked(load_splats(output))
    return status


_WORDS = ("gltf", "usda")
_USD = ("usda", "usdc", "usdz")

LAYERS: dict[str, Layer] = {
    **{ending: _on_disk(ending) for ending in formats.FORMATS},
    "lod-meta.json": _streamed_layer("lod-meta.json"),
    "tileset.json": _streamed_layer("tileset.json"),
    "html": Layer("a.html", lambda: _html_parts()[1], _html_around, text=True),
    "ply, header and words": Layer("a.ply", _whole("ply"), text=True),
    "ply, ascii": Layer("a.ply", _ascii_ply, text=True),
    "spz, unpacked": Layer(
        "a.spz",
        lambda: gzip.decompress(files("spz")["a.spz"]),
        lambda inside: gzip.compress(inside, 1),
    ),
    **{
        f"ksplat, level {level}": Layer("a.ksplat", (_KSPLAT / f"level_{level}.ksplat").read_bytes)
        for level in range(3)
    },
    "spz 4": Layer("a.spz", _SPZ_4.read_bytes),
    "spz 4, unpacked": Layer("a.spz", lambda: b"".join([_spz_4()[0], *_spz_4()[1]]), _spz_4_with),
    "sog, meta.json": _part("sog", "meta.json", text=True),
    "sog, a picture": _part("sog", "means_l.webp", text=False),
    "glb, document": _glb_document("glb"),
    "quantised.glb, document": _glb_document("quantised.glb"),
    "spz.glb, document": _glb_document("spz.glb"),
    "html, unpacked": Layer("a.html", _html_inside, _html_with, text=True),
    **camera_layers.LAYERS,
    **photo_layers.LAYERS,
    **run_layers.LAYERS,
}
