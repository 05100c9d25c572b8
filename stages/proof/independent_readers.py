"""Independent readers, which check what the writers wrote.

None of them shares code with its writer: plyfile, pygltflib with raw accessors, attributes from
usd-core, the bytes of .splat, and the standard library's HTML parser for .html. They leave the
splats in the axes of the file. The check moves the camera into these axes instead of turning the
splats, so that a wrong rotation of positions, quaternions or SH shows in the picture.
"""

from __future__ import annotations

import base64
import json
import math
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData
from pygltflib import GLTF2

from stages.base.row_slices import release_mapped_pages
from stages.base.usd_path import accepted_path
from stages.formats.values import concatenate
from stages.proof.content import (
    NotCrossCheckedError,
    logits,
    says_antialiased,
    splats_by_rows,
    splats_of,
)
from stages.proof.independent_packed import compressed_ply, spz_content
from stages.scene import Splats

_PLY_ROWS = 1 << 14  # columns are gathered from the cache
_FAR_UNITS = 1000  # positions farther out need more than the float32 of `Splats`
_PAGE_PIECE = 1 << 22  # characters: the parser scans an unfinished element once a piece


def ply(path: Path) -> Splats:
    content = PlyData.read(str(path), mmap="c")
    if "chunk" in content:
        return compressed_ply(path)
    vertex = content["vertex"]
    wide = content.text or any(vertex.data.dtype[axis].itemsize > 4 for axis in "xyz")
    if wide and any(np.abs(np.median(vertex[axis])) > _FAR_UNITS for axis in "xyz"):
        raise NotCrossCheckedError("positions far from zero, more precise than float32")
    per_channel = sum(item.name.startswith("f_rest_") for item in vertex.properties) // 3

    def values_of(part: slice) -> dict[str, NDArray[np.floating]]:
        rows = vertex.data[part]
        sh = np.empty((len(rows), per_channel + 1, 3), np.float32)
        for i in range(3):
            sh[:, 0, i] = rows[f"f_dc_{i}"]
            for k in range(per_channel):
                sh[:, k + 1, i] = rows[f"f_rest_{i * per_channel + k}"]
        found = {
            "means": np.stack([rows[axis] for axis in "xyz"], axis=1),
            "quaternions": np.stack([rows[f"rot_{i}"] for i in range(4)], axis=1),
            "log_scales": np.stack([rows[f"scale_{i}"] for i in range(3)], axis=1),
            "opacity_logits": rows["opacity"],
            "sh": sh,
        }
        release_mapped_pages(vertex.data)
        return found

    splats = splats_by_rows(len(vertex.data), values_of, _PLY_ROWS)
    comments = [*content.comments, *(line for part in content for line in part.comments)]
    return splats.with_antialias(says_antialiased(comments))


class _Chunks(HTMLParser):
    """Unpacks the script elements of class "splats" into a file, as a browser would."""

    def __init__(self, target: BinaryIO) -> None:
        super().__init__()
        self.target = target
        self.wanted = False
        self.held: list[str] = []
        self.unpacker = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.wanted = tag == "script" and ("class", "splats") in attrs

    def handle_data(self, data: str) -> None:
        if self.wanted:
            self.held.append(data)

    def handle_endtag(self, tag: str) -> None:
        packed = base64.b64decode("".join(self.held), validate=True)
        self.target.write(self.unpacker.decompress(packed))
        self.held.clear()
        self.wanted = False


def html(path: Path) -> Splats:
    with tempfile.TemporaryDirectory(prefix="splat-") as folder:
        inside = Path(folder) / "inside.ply"
        with path.open(encoding="utf-8") as page, inside.open("wb") as target:
            parser = _Chunks(target)
            while piece := page.read(_PAGE_PIECE):
                parser.feed(piece)
            parser.close()
        assert parser.unpacker.eof, "its splats are cut short"
        return ply(inside)


def splat(path: Path) -> Splats:
    size = path.stat().st_size
    assert size % 32 == 0, "its records are not all whole"

    def values_of(rows: slice) -> dict[str, NDArray[np.floating]]:
        count = 32 * (rows.stop - rows.start)
        part = np.fromfile(path, np.uint8, count, offset=32 * rows.start).reshape(-1, 32)
        floats = np.ascontiguousarray(part[:, :24]).view("<f4")
        colours = part[:, 24:28].astype(np.float32) / 255
        return {
            "means": floats[:, :3],
            "quaternions": (part[:, 28:].astype(np.float32) - 128) / 128,
            "log_scales": np.log(floats[:, 3:], dtype=np.float64),
            "opacity_logits": logits(colours[:, 3]),
            "sh": ((colours[:, :3] - 0.5) * math.sqrt(4 * math.pi))[:, None, :],
        }

    return splats_by_rows(size // 32, values_of)


_Buffer = Callable[[int, int], bytes]  # (first byte, length) -> as many bytes as there are


def _in_file(path: Path, begins: int = 0) -> _Buffer:
    return lambda start, length: np.fromfile(
        path, np.uint8, length, offset=begins + start
    ).tobytes()


def _gltf_buffer(folder: Path, uri: str) -> _Buffer:
    if not uri.startswith("data:"):
        return _in_file(folder / unquote(uri))
    content = base64.b64decode(uri.partition(",")[2], validate=True)
    return lambda start, length: content[start : start + length]


def _gltf_parts(path: Path) -> tuple[Any, list[_Buffer]]:
    """(the document, its buffers)."""
    if path.suffix.lower() == ".gltf":
        document = GLTF2.gltf_from_json(path.read_text(encoding="utf-8"))
        return document, [_gltf_buffer(path.parent, buffer.uri) for buffer in document.buffers]
    with path.open("rb") as file:
        head = np.frombuffer(file.read(20), "<u4")
        assert file.seek(0, 2) == head[2], "its length is not that of its header"
        file.seek(20)
        document = GLTF2.gltf_from_json(file.read(int(head[3])).decode("utf-8"))
    more = [_gltf_buffer(path.parent, buffer.uri) for buffer in document.buffers[1:]]
    return document, [_in_file(path, 20 + int(head[3]) + 8), *more]


def _node_scale(document: Any) -> float:
    """The scale of the only node but cameras. Raises NotCrossCheckedError for another placement."""
    nodes = [node for node in document.nodes if node.camera is None]
    scales = [node.scale or [1.0, 1.0, 1.0] for node in nodes]
    moved = any(
        any(node.translation or ()) or any((node.rotation or ())[:3]) or node.matrix
        for node in nodes
    )
    single = len(scales) == 1 and len(set(scales[0])) == 1
    if moved or len(document.meshes) > 1 or not (single or all(s == [1] * 3 for s in scales)):
        raise NotCrossCheckedError("nodes that place splats")
    return float(scales[0][0]) if scales else 1.0


def gltf(path: Path) -> Splats:
    document, buffers = _gltf_parts(path)
    scale = _node_scale(document)

    def values(primitive: Any, name: str) -> NDArray[np.floating]:
        accessor = document.accessors[getattr(primitive.attributes, name)]
        view = document.bufferViews[accessor.bufferView]
        return _accessor_values(accessor, view, buffers[view.buffer])

    prefix = "KHR_gaussian_splatting:"
    parts = []
    for primitive in document.meshes[0].primitives if document.meshes else []:
        compressions = primitive.extensions[prefix[:-1]].get("extensions", {})
        if spz := compressions.get("KHR_gaussian_splatting_compression_spz_2"):
            view = document.bufferViews[spz["bufferView"]]
            content = buffers[view.buffer](view.byteOffset or 0, view.byteLength)
            part = spz_content(content)
            means, log_scales = scale * part.means, part.log_scales + np.float32(math.log(scale))
            parts.append(replace(part, means=means, log_scales=log_scales))
            continue
        coefficients = [
            f"{prefix}SH_DEGREE_{d}_COEF_{i}"
            for d in range(4)
            for i in range(2 * d + 1)
            if hasattr(primitive.attributes, f"{prefix}SH_DEGREE_{d}_COEF_{i}")
        ]
        degree_0 = document.accessors[getattr(primitive.attributes, coefficients[0])]
        sh = np.zeros((degree_0.count, 16, 3), np.float32)
        for k, name in enumerate(coefficients):
            sh[:, k] = values(primitive, name)
        xyzw = values(primitive, f"{prefix}ROTATION")
        parts.append(
            splats_of(
                means=scale * values(primitive, "POSITION"),
                quaternions=np.roll(xyzw, 1, axis=1),
                log_scales=np.log(scale * values(primitive, f"{prefix}SCALE").astype(np.float64)),
                opacity_logits=logits(values(primitive, f"{prefix}OPACITY")[:, 0]),
                sh=sh,
            )
        )
    packed_antialias = any(part.draw_settings.antialias for part in parts)
    antialias = (document.asset.extras or {}).get("antialiased", packed_antialias)
    return concatenate(parts).with_antialias(antialias)


def tileset(path: Path) -> Splats:
    """The tiles that nothing replaces, from left to right."""
    found: list[Splats] = []

    def visit(tile: dict[str, Any], refine: str = "REPLACE") -> None:
        refine = tile.get("refine", refine)
        if "content" in tile and (refine == "ADD" or not tile.get("children")):
            found.append(gltf(path.parent / tile["content"]["uri"]))
        for child in tile.get("children", ()):
            visit(child, refine)

    visit(json.loads(path.read_text("utf-8"))["root"])
    return concatenate(found).with_antialias(any(s.draw_settings.antialias for s in found))


def _accessor_values(accessor: Any, view: Any, buffer: _Buffer) -> NDArray[np.floating]:
    """[count, components], one element after the other; c / (2^b - 1) or, signed,
    c / (2^(b - 1) - 1) of normalised integers (glTF 2.0, section 3.6.2.2)."""
    kind = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}[accessor.componentType]
    largest = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535, 5126: 1}[accessor.componentType]
    element = np.dtype((kind, ({"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type],)))
    step = view.byteStride or element.itemsize
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    # a record whose padding is the space between two elements; the last element may lack it
    record = np.dtype({"names": ["v"], "formats": [element], "offsets": [0], "itemsize": step})
    length = accessor.count * step
    data = buffer(start, length).ljust(length, b"\0")
    values = np.frombuffer(data, record, accessor.count)["v"]
    if not accessor.normalized:
        return values
    return np.clip(values.astype(np.float64) / largest, -1, 1)


def usd(path: Path) -> Splats:
    with accepted_path(path) as name:
        return _usd(name)


def _usd(name: str) -> Splats:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    # The column in which each of w, x, y, z arrives, measured instead of assumed.
    columns = np.argsort(np.array(Vt.QuatfArray([Gf.Quatf(1, 2, 3, 4)]))[0])
    # Without the library's cache, which may hold an older file of the same name.
    stage = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(name))
    parts = []
    for prim in stage.Traverse():
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue
        if UsdGeom.XformCache().GetLocalToWorldTransform(prim) != Gf.Matrix4d(1):
            raise NotCrossCheckedError("prims that place splats")
        get = prim.GetAttribute
        if get("positions").Get() is None:
            raise NotCrossCheckedError("values of half precision")
        degree = get("radiance:sphericalHarmonicsDegree").Get()
        # Copied, because Numba would compile all kernels again for read-only arrays.
        coefficients = np.array(get("radiance:sphericalHarmonicsCoefficients").Get(), np.float32)
        parts.append(
            splats_of(
                means=np.array(get("positions").Get(), np.float32),
                quaternions=np.asarray(get("orientations").Get(), np.float32)[:, columns],
                log_scales=np.log(np.asarray(get("scales").Get()), dtype=np.float64),
                opacity_logits=logits(np.asarray(get("opacities").Get())),
                sh=coefficients.reshape(-1, (degree + 1) ** 2, 3),
            )
        )
    note = stage.GetRootLayer().customLayerData.get("splat")
    antialias = isinstance(note, dict) and note.get("antialiased", False)
    return concatenate(parts).with_antialias(antialias)
