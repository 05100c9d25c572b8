"""Second readers, for checking what the writers wrote.

None of them shares code with its writer: plyfile, pygltflib with raw accessors, usd-core's
attributes, a byte-wise reading of .splat, and for .html the standard library's HTML parser. They
leave the splats in the file's own axes and say how those lie in our world, so that a check can
move the camera instead of the splats: then a wrong turn of positions, rotations or SH shows in the
picture.
"""

from __future__ import annotations

import base64
import gzip
import io
import math
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.formats import format_of, verify_packed
from stages.formats.verify_content import Y_UP, FileContent, logits, splats_of
from stages.scene import Splats

__all__ = ["FileContent", "read_back"]


def read_back(path: Path) -> FileContent:
    """What another program would find in the file. Raises whatever its parser raises: a file that
    was just written has no excuse."""
    with np.errstate(all="ignore"):  # flat splats have a logarithm of -infinity
        return _READERS[format_of(path)](path)


def _ply(source: Any) -> FileContent:
    """source: a path, or an open binary file."""
    from plyfile import PlyData

    named = isinstance(source, Path)
    data = PlyData.read(str(source), mmap="c") if named else PlyData.read(source)
    vertex = data["vertex"]
    names = [item.name for item in vertex.properties]
    per_channel = sum(name.startswith("f_rest_") for name in names) // 3
    sh = np.zeros((len(vertex.data), per_channel + 1, 3), np.float32)
    for channel in range(3):
        sh[:, 0, channel] = vertex[f"f_dc_{channel}"]
        for k in range(per_channel):
            sh[:, k + 1, channel] = vertex[f"f_rest_{channel * per_channel + k}"]
    splats = splats_of(
        means=np.stack([vertex[c] for c in "xyz"], axis=1),
        quaternions=np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1),
        log_scales=np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1),
        opacity_logits=np.asarray(vertex["opacity"]),
        sh=sh,
    )
    return FileContent(splats, np.eye(4))


class _Chunks(HTMLParser):
    """Collects what a browser would find in the script elements of class "splats"."""

    def __init__(self) -> None:
        super().__init__()
        self.wanted = False
        self.chunks: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.wanted = tag == "script" and ("class", "splats") in attrs

    def handle_data(self, data: str) -> None:
        if self.wanted:
            self.chunks.append(data)

    def handle_endtag(self, tag: str) -> None:
        self.wanted = False


def _html(path: Path) -> FileContent:
    parser = _Chunks()
    parser.feed(path.read_text(encoding="utf-8"))
    packed = b"".join(base64.b64decode(chunk, validate=True) for chunk in parser.chunks)
    return _ply(io.BytesIO(gzip.decompress(packed)))


def _splat(path: Path) -> FileContent:
    records = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 32)
    floats = np.ascontiguousarray(records[:, :24]).view("<f4").astype(np.float64)
    colours = records[:, 24:28] / 255.0
    splats = splats_of(
        means=floats[:, :3],
        quaternions=(records[:, 28:].astype(np.float64) - 128.0) / 128.0,
        log_scales=np.log(floats[:, 3:]),
        opacity_logits=logits(colours[:, 3]),
        sh=((colours[:, :3] - 0.5) * math.sqrt(4 * math.pi))[:, None, :],
    )
    return FileContent(splats, np.eye(4))


def _gltf(path: Path) -> FileContent:
    from urllib.parse import unquote

    from pygltflib import GLTF2

    document = GLTF2().load(str(path))
    assert document is not None
    if path.suffix.lower() == ".gltf" and document.buffers:
        blob = (path.parent / unquote(document.buffers[0].uri)).read_bytes()
    else:
        blob = document.binary_blob() or b""
    kinds = {5121: np.uint8, 5123: np.uint16, 5126: np.float32}
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def values(primitive: Any, name: str) -> NDArray[np.floating]:
        accessor = document.accessors[getattr(primitive.attributes, name)]
        view = document.bufferViews[accessor.bufferView]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        count = accessor.count * widths[accessor.type]
        flat = np.frombuffer(blob, kinds[accessor.componentType], count, start)
        return flat.reshape(accessor.count, widths[accessor.type])

    prefix = "KHR_gaussian_splatting:"
    parts = []
    for primitive in document.meshes[0].primitives if document.meshes else []:
        bands = [
            values(primitive, f"{prefix}SH_DEGREE_{d}_COEF_{i}")
            for d in range(4)
            for i in range(2 * d + 1)
            if hasattr(primitive.attributes, f"{prefix}SH_DEGREE_{d}_COEF_{i}")
        ]
        sh = np.zeros((len(bands[0]), 16, 3), np.float32)
        sh[:, : len(bands)] = np.stack(bands, axis=1)
        xyzw = values(primitive, f"{prefix}ROTATION")
        parts.append(
            splats_of(
                means=values(primitive, "POSITION"),
                quaternions=np.roll(xyzw, 1, axis=1),
                log_scales=np.log(values(primitive, f"{prefix}SCALE").astype(np.float64)),
                opacity_logits=logits(values(primitive, f"{prefix}OPACITY")[:, 0]),
                sh=sh,
            )
        )
    return FileContent(_concatenated(parts), Y_UP)


def _usd(path: Path) -> FileContent:
    from pxr import Gf, Usd, Vt

    # In which column each of w, x, y, z arrives, found out and not assumed.
    columns = np.argsort(np.array(Vt.QuatfArray([Gf.Quatf(1, 2, 3, 4)]))[0])
    stage = Usd.Stage.Open(str(path))
    stage.Reload()  # the library's cache may hold an older file of the same name
    parts = []
    for prim in stage.Traverse():
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue
        get = prim.GetAttribute
        degree = get("radiance:sphericalHarmonicsDegree").Get()
        coefficients = np.array(get("radiance:sphericalHarmonicsCoefficients").Get(), np.float32)
        sh = coefficients.reshape(-1, (degree + 1) ** 2, 3)
        parts.append(
            splats_of(
                means=np.array(get("positions").Get(), np.float32),
                quaternions=np.array(get("orientations").Get(), np.float32)[:, columns],
                log_scales=np.log(np.array(get("scales").Get(), np.float64)),
                opacity_logits=logits(np.array(get("opacities").Get())),
                sh=sh,
            )
        )
    return FileContent(_concatenated(parts), Y_UP)


def _concatenated(parts: list[Splats]) -> Splats:
    if not parts:
        shapes = {"means": 3, "quaternions": 4, "log_scales": 3}
        empty = {name: np.zeros((0, width)) for name, width in shapes.items()}
        return splats_of(**empty, opacity_logits=np.zeros(0), sh=np.zeros((0, 1, 3)))
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return splats_of(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


_READERS = {
    "ply": _ply,
    "splat": _splat,
    "glb": _gltf,
    "gltf": _gltf,
    "usda": _usd,
    "usdc": _usd,
    "usdz": _usd,
    "compressed.ply": verify_packed.compressed_ply,
    "spz": verify_packed.spz,
    "sog": verify_packed.sog,
    "html": _html,
}
