"""Reads KHR_gaussian_splatting, also compressed as SPZ, written by this project or by others.

Every number of the JSON is checked before use, because a file may come from anywhere. Buffers are
the binary chunk, data: URIs, or files in its folder or below; nothing is fetched.
"""

from __future__ import annotations

import base64
import io
import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.formats import spz_read
from stages.formats.first_camera import camera_of
from stages.formats.gltf_file import EXTENSION, SPZ_EXTENSION
from stages.formats.inflate import check_size
from stages.formats.json_fields import located, numbers, whole
from stages.formats.values import concatenate, log_scales_of, logits_of
from stages.scene import Camera, Splats
from stages.scene.flip import flipped
from stages.scene.recentring import recentred_splats
from stages.scene.rotations import matrices_of

_TYPES = {5120: "i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_ASPECT = 4 / 3  # of cameras that state none
_MIN_SPLAT_BYTES = 12 + 4 + 3 + 1 + 12  # with every attribute at its narrowest type


def read(path: Path) -> Splats:
    """All splats of the scene, y down, float32.

    Nodes may be translated and uniformly scaled; positions far from zero keep their precision in
    `origin`. Of cameras the first in perspective is kept. Raises BadFileError for a damaged file,
    one without splats, one that refers to files outside its folder, or an unsupported feature
    (sparse accessors, other compression, splats in rotated nodes).
    """
    document, chunk = _parse(path)
    buffers = _Buffers(path, _list(document, "buffers"), chunk)
    source = _Source(document, buffers)
    parts: list[Splats] = []
    nodes = _nodes(document)
    for node, matrix in nodes:
        for part in source.splats(node, matrix):
            parts.append(part)
            # Splats that are not shared cannot be more than this, which bounds the memory.
            most = buffers.total_bytes() + sum(source.unpacked_bytes.values())
            if sum(map(len, parts)) * _MIN_SPLAT_BYTES > most:
                raise BadFileError("its nodes share meshes, which is not supported")
    extras = document["asset"].get("extras")
    extras = extras if isinstance(extras, dict) else {}
    if not parts and "meshes" in document:
        raise BadFileError(f"it is a mesh, not splats: nothing in it uses {EXTENSION}")
    antialias = any(part.draw_settings.antialias for part in parts)  # as SPZ says
    splats = concatenate(parts)
    del parts
    splats = located(splats, extras)
    splats = replace(splats, first_camera=_first_camera(document, nodes))
    splats = recentred_splats(splats).with_antialias(bool(extras.get("antialiased", antialias)))
    return flipped(splats, reuse=True)


def _parse(path: Path) -> tuple[dict[str, Any], memoryview | None]:
    """(the JSON, the binary chunk of a .glb)."""
    content = _mapped(path)
    chunk: memoryview | None = None
    if bytes(content[:4]) == b"glTF":
        if len(content) < 20:
            raise BadFileError("it is cut short")
        _, version, total, size, kind = struct.unpack_from("<4sIII4s", content)
        if version != 2:
            raise BadFileError(f"it is glTF version {version}, not 2")
        if total > len(content) or kind != b"JSON" or 20 + size > total:
            raise BadFileError(f"it is cut short: {total} bytes declared, {len(content)} there")
        text = content[20 : 20 + size]
        rest = content[20 + size : total]
        if rest:
            if len(rest) < 8:
                raise BadFileError("it is cut short")
            length, kind = struct.unpack_from("<I4s", rest)
            if kind == b"BIN\0":
                if 8 + length > len(rest):
                    raise BadFileError("its binary chunk is cut short")
                chunk = rest[8 : 8 + length]
    else:
        text = content
    document = json.loads(bytes(text).decode("utf-8"))
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise BadFileError("it is not a glTF document")
    if str(document["asset"].get("version")).split(".")[0] != "2":
        raise BadFileError("it is not glTF version 2")
    required = set(_list(document, "extensionsRequired")) - {EXTENSION, SPZ_EXTENSION}
    if required:
        raise BadFileError(f"it requires {', '.join(sorted(map(str, required)))[:80]}")
    return document, chunk


def _mapped(path: Path) -> memoryview:
    """The bytes of the file, mapped copy-on-write: Numba would compile kernels again for read-only
    arrays."""
    return np.memmap(path, np.uint8, "c").data


class _Buffers:
    """The buffers of the document; each is loaded at its first use."""

    def __init__(self, path: Path, described: list[Any], chunk: memoryview | None) -> None:
        self._path, self._described, self._chunk = path, described, chunk
        self._loaded: dict[int, memoryview] = {}
        self._files: dict[Path, memoryview] = {}  # a file counts once, however many buffers it is

    def get(self, index: int) -> memoryview:
        if index not in self._loaded:
            content = self._load(_item(self._described, index, "buffer"), index)
            length = whole(self._described[index], "byteLength")
            if length > len(content):
                raise BadFileError(f"buffer {index} is cut short: {len(content)} of {length} bytes")
            self._loaded[index] = content
        return self._loaded[index]

    def total_bytes(self) -> int:
        return sum({id(content): len(content) for content in self._loaded.values()}.values())

    def _load(self, described: dict[str, Any], index: int) -> memoryview:
        uri = described.get("uri")
        if uri is None:
            if index != 0 or self._chunk is None:
                raise BadFileError(f"buffer {index} has no content")
            return self._chunk
        if not isinstance(uri, str):
            raise BadFileError(f"the address of buffer {index} is not text")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise BadFileError(f"buffer {index} has an encoding that is not read")
            return memoryview(base64.b64decode(body, validate=True))
        file = _file_beside(self._path, uri)
        return self._files.setdefault(file, _mapped(file))


def _file_beside(path: Path, uri: str) -> Path:
    """The file that a relative URI names. Raises BadFileError if it lies outside the folder."""
    parts = urlsplit(uri)
    name = unquote(parts.path)
    folder = path.parent.resolve()
    inside = not (parts.scheme or parts.netloc or "\\" in name or "\0" in name)
    target = (folder / name).resolve() if inside else folder
    if not inside or not name or not target.is_relative_to(folder):
        raise BadFileError(f"it refers to {uri[:80]!r}, which is not a file in its own folder")
    if not target.is_file():
        raise BadFileError(f"{name[:80]!r}, which it refers to, is not there")
    return target


_Placed = tuple[dict[str, Any], NDArray[np.float64]]  # a node, and [4, 4] from it to the world


def _nodes(document: dict[str, Any]) -> list[_Placed]:
    """The nodes of the scene, each at most once."""
    nodes, scenes = _list(document, "nodes"), _list(document, "scenes")
    if scenes:
        index = document.get("scene", 0)
        roots = _list(_item(scenes, index, "scene"), "nodes")
    else:
        children = {
            child for node in nodes if isinstance(node, dict) for child in _list(node, "children")
        }
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting: list[tuple[Any, NDArray[np.float64]]] = [
        (index, np.eye(4)) for index in reversed(roots)
    ]
    placed: list[_Placed] = []
    seen: set[int] = set()
    while waiting:
        index, parent = waiting.pop()
        node = _item(nodes, index, "node")
        if index in seen:
            raise BadFileError("a node has two parents")
        seen.add(index)
        matrix = parent @ _matrix_of(node)
        placed.append((node, matrix))
        waiting += [(child, matrix) for child in reversed(_list(node, "children"))]
    return placed


def _matrix_of(node: dict[str, Any]) -> NDArray[np.float64]:
    """[4, 4] from a node to its parent."""
    if "matrix" in node:
        return numbers(node, "matrix", 16).reshape(4, 4).T
    x, y, z, w = numbers(node, "rotation", 4, [0, 0, 0, 1])
    matrix = np.eye(4)
    matrix[:3, :3] = matrices_of(np.array([w, x, y, z])) * numbers(node, "scale", 3, [1, 1, 1])
    matrix[:3, 3] = numbers(node, "translation", 3, [0, 0, 0])
    return matrix


def _scale_and_offset(matrix: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """(scale, offset [3]) of a node with splats. Raises BadFileError for other transforms."""
    scale = float(matrix[0, 0])
    uneven = np.abs(matrix[:3, :3] - scale * np.eye(3)).max()
    if not (scale > 0 and uneven <= 1e-6 * scale and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise BadFileError("its splats are rotated, mirrored or stretched, which is not supported")
    return scale, matrix[:3, 3]


def _first_camera(document: dict[str, Any], nodes: list[_Placed]) -> Camera | None:
    """The first camera in perspective, in the axes of the file; None if there is none."""
    for node, matrix in nodes:
        if "camera" in node:
            described = _item(_list(document, "cameras"), node["camera"], "camera")
            if isinstance(lens := described.get("perspective"), dict):
                high = 2 * math.tan(float(lens.get("yfov", 0)) / 2)
                return camera_of(matrix, high * float(lens.get("aspectRatio", _ASPECT)), high)
    return None


@dataclass(frozen=True)
class _Source:
    """unpacked_bytes: by buffer view of SPZ, at least what its splats would take uncompressed."""

    document: dict[str, Any]
    buffers: _Buffers
    unpacked_bytes: dict[int, int] = field(default_factory=dict)

    def splats(self, node: dict[str, Any], matrix: NDArray[np.float64]) -> Iterator[Splats]:
        """The splats of a node's mesh, primitive after primitive, in the file's axes."""
        if "mesh" not in node:
            return
        mesh = _item(_list(self.document, "meshes"), node["mesh"], "mesh")
        for primitive in _list(mesh, "primitives"):
            extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
            if isinstance(extensions, dict) and isinstance(extensions.get(EXTENSION), dict):
                placed = _scale_and_offset(matrix)
                yield self._primitive(primitive, extensions[EXTENSION], *placed)

    def _primitive(
        self,
        primitive: dict[str, Any],
        extension: dict[str, Any],
        scale: float,
        offset: NDArray[np.float64],
    ) -> Splats:
        compressions = extension.get("extensions")
        if isinstance(compressions, dict) and isinstance(compressions.get(SPZ_EXTENSION), dict):
            said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | extension
            _check_drawing(said)
            return self._spz(whole(compressions[SPZ_EXTENSION], "bufferView"), scale, offset)
        _check_drawing(extension)
        if extension.get("extensions"):
            raise BadFileError("its splats are compressed in a way that is not supported")
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise BadFileError("a primitive has no attributes")
        degree = max(
            d for d in range(4) if d == 0 or f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in attributes
        )

        def values(name: str, width: int) -> NDArray[np.float32]:
            if name not in attributes:
                raise BadFileError(f"a primitive lacks {name}")
            return self._accessor(attributes[name], width)

        means = values("POSITION", 3)
        rotations = values(f"{EXTENSION}:ROTATION", 4)
        scales = values(f"{EXTENSION}:SCALE", 3)
        opacities = values(f"{EXTENSION}:OPACITY", 1)
        if len({len(array) for array in (means, rotations, scales, opacities)}) != 1:
            raise BadFileError("the attributes of a primitive differ in length")
        sh = np.empty((len(means), (degree + 1) ** 2, 3), np.float32)
        for d in range(degree + 1):
            for i in range(2 * d + 1):
                coefficient = values(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}", 3)
                if len(coefficient) != len(means):
                    raise BadFileError("the attributes of a primitive differ in length")
                sh[:, d * d + i] = coefficient
        return Splats(
            # float64: `read` recentres them
            means=means.astype(np.float64) * scale + offset,
            quaternions=rotations[:, [3, 0, 1, 2]],
            log_scales=log_scales_of(scales, scale),
            opacity_logits=logits_of(opacities[:, 0]),
            sh=sh,
            sh_degrees=np.full(len(means), degree, np.uint8),
        )

    def _spz(self, index: int, scale: float, offset: NDArray[np.float64]) -> Splats:
        """The splats of SPZ in a buffer view, stored in the axes of glTF: see `gltf_spz`."""
        content = bytes(self._view(index))
        splats, _ = spz_read.unpack(io.BytesIO(content), len(content))
        self.unpacked_bytes[index] = len(splats) * _MIN_SPLAT_BYTES
        check_size(sum(self.unpacked_bytes.values()), self.buffers.total_bytes())
        return replace(
            splats,
            means=splats.means.astype(np.float64) * scale + offset,
            log_scales=splats.log_scales + np.float32(math.log(scale)),
        )

    def _view(self, index: Any) -> memoryview:
        view = _item(_list(self.document, "bufferViews"), index, "buffer view")
        content = self.buffers.get(whole(view, "buffer"))
        start, length = whole(view, "byteOffset", 0), whole(view, "byteLength")
        if start + length > len(content):
            raise BadFileError(f"buffer view {index} reaches past its buffer")
        return content[start : start + length]

    def _accessor(self, index: Any, width: int) -> NDArray[np.float32]:
        """[count, width] float32, normalised integers decoded."""
        accessor = _item(_list(self.document, "accessors"), index, "accessor")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise BadFileError(f"accessor {index} is sparse or empty, which is not supported")
        if (
            accessor.get("componentType") not in _TYPES
            or _WIDTHS.get(str(accessor.get("type"))) != width
        ):
            raise BadFileError(f"accessor {index} has a type that its attribute must not have")
        dtype = np.dtype(_TYPES[accessor["componentType"]])
        count = whole(accessor, "count")
        content = self._view(accessor["bufferView"])
        view = self.document["bufferViews"][accessor["bufferView"]]
        offset = whole(accessor, "byteOffset", 0)
        element = dtype.itemsize * width
        row_bytes = whole(view, "byteStride", element)
        if row_bytes < element or (row_bytes > 252 and row_bytes != element):
            raise BadFileError(
                f"accessor {index} has byteStride {row_bytes} for elements of {element}"
            )
        if offset + (count - 1) * row_bytes + element > len(content):
            raise BadFileError(f"accessor {index} reaches past its buffer")
        if count * _MIN_SPLAT_BYTES > self.buffers.total_bytes():
            raise BadFileError(f"accessor {index} counts more splats than its buffers can hold")
        raw: NDArray[Any] = np.ndarray(
            (count, width), dtype, content, offset, (row_bytes, dtype.itemsize)
        )
        values = raw.astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
        return values


def _check_drawing(extension: dict[str, Any]) -> None:
    """Raises BadFileError for splats that are to be drawn in another way than ours."""
    if extension.get("kernel") != "ellipse":
        raise BadFileError("its splats have another kernel than ellipse")
    if extension.get("colorSpace") != "srgb_rec709_display":
        raise BadFileError("its colours are in another space than srgb_rec709_display")


def _list(holder: dict[str, Any], key: str) -> list[Any]:
    value = holder.get(key, [])
    if not isinstance(value, list):
        raise BadFileError(f"its {key} are not a list")
    return value


def _item(items: list[Any], index: Any, what: str) -> dict[str, Any]:
    if type(index) is not int or not 0 <= index < len(items) or not isinstance(items[index], dict):
        raise BadFileError(f"it refers to {what} {str(index)[:40]}, which it does not hold")
    item: dict[str, Any] = items[index]
    return item
