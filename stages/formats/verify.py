"""Second readers, for checking what the writers wrote.

None of them shares code with its writer: plyfile, pygltflib with raw accessors, usd-core's
attributes, and a byte-wise reading of .splat. They leave the splats in the file's own axes and
say how those lie in our world, so that a check can move the camera instead of the splats: then a
wrong turn of positions, rotations or SH shows in the picture.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.formats import format_of
from stages.scene import Splats

_Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class FileContent:
    """splats: as the file holds them, in its axes. world_from_file [4, 4]: from those axes to
    ours (y down)."""

    splats: Splats
    world_from_file: NDArray[np.float64]


def read_back(path: Path) -> FileContent:
    """What another program would find in the file. Raises whatever its parser raises: a file that
    was just written has no excuse."""
    return _READERS[format_of(path)](path)


def _ply(path: Path) -> FileContent:
    from plyfile import PlyData

    vertex = PlyData.read(str(path), mmap="c")["vertex"]
    names = [item.name for item in vertex.properties]
    per_channel = sum(name.startswith("f_rest_") for name in names) // 3
    sh = np.zeros((len(vertex.data), per_channel + 1, 3), np.float32)
    for channel in range(3):
        sh[:, 0, channel] = vertex[f"f_dc_{channel}"]
        for k in range(per_channel):
            sh[:, k + 1, channel] = vertex[f"f_rest_{channel * per_channel + k}"]
    splats = _splats(
        means=np.stack([vertex[c] for c in "xyz"], axis=1),
        quaternions=np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1),
        log_scales=np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1),
        opacity_logits=np.asarray(vertex["opacity"]),
        sh=sh,
    )
    return FileContent(splats, np.eye(4))


def _splat(path: Path) -> FileContent:
    records = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 32)
    floats = np.ascontiguousarray(records[:, :24]).view("<f4").astype(np.float64)
    colours = records[:, 24:28] / 255.0
    splats = _splats(
        means=floats[:, :3],
        quaternions=(records[:, 28:].astype(np.float64) - 128.0) / 128.0,
        log_scales=np.log(floats[:, 3:]),
        opacity_logits=_logits(colours[:, 3]),
        sh=((colours[:, :3] - 0.5) * math.sqrt(4 * math.pi))[:, None, :],
    )
    return FileContent(splats, np.eye(4))


def _compressed_ply(path: Path) -> FileContent:
    from plyfile import PlyData

    data = PlyData.read(str(path), mmap="c")
    words, chunk = data["vertex"], np.arange(data["vertex"].count) // 256

    def unpacked(name: str, columns: list[tuple[str, int, int]]) -> NDArray[np.float64]:
        """columns: (suffix of the range's names, lowest bit, bits)."""
        parts = []
        for suffix, shift, bits in columns:
            fraction = (words[name].astype(np.int64) >> shift) % 2**bits / (2**bits - 1)
            low, high = (data["chunk"][e + suffix].astype(float)[chunk] for e in ("min_", "max_"))
            parts.append(low * (1 - fraction) + high * fraction)
        return np.stack(parts, axis=1)

    axes = [("x", 21, 11), ("y", 11, 10), ("z", 0, 11)]
    turns = words["packed_rotation"].astype(np.int64)
    others = [((turns >> shift) % 1024 / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
    colours = unpacked("packed_color", [("r", 24, 8), ("g", 16, 8), ("b", 8, 8)])
    rest = data["sh"].data if "sh" in data else np.zeros((len(chunk), 0), np.uint8)
    sh = np.zeros((len(chunk), len(rest.dtype.names or ()) // 3 + 1, 3))
    sh[:, 0] = (colours - 0.5) * math.sqrt(4 * math.pi)
    for i, name in enumerate(rest.dtype.names or ()):
        per_channel = sh.shape[1] - 1
        sh[:, 1 + i % per_channel, i // per_channel] = (rest[name] + 0.5) / 32 - 4
    splats = _splats(
        means=unpacked("packed_position", axes),
        quaternions=_with_largest(turns >> 30, np.stack(others, axis=1)),
        log_scales=unpacked("packed_scale", [("scale_" + s, low, n) for s, low, n in axes]),
        opacity_logits=_logits(words["packed_color"].astype(np.int64) % 256 / 255),
        sh=sh,
    )
    return FileContent(splats, np.eye(4))


def _spz(path: Path) -> FileContent:
    import gzip
    import struct

    content = gzip.decompress(path.read_bytes())
    magic, version, n, degree, fraction = struct.unpack_from("<IIIBB", content)
    assert (magic, version) == (0x5053474E, 3), "the header is not that of version 3"
    k = (degree + 1) ** 2 - 1
    ends = 16 + np.cumsum([0, 9 * n, n, 3 * n, 3 * n, 4 * n, 3 * k * n])
    assert len(content) == ends[-1], "the length is not that of the header"
    parts = [np.frombuffer(content[a:b], np.uint8) for a, b in itertools.pairwise(ends)]
    low, middle, high = parts[0].reshape(n, 3, 3).astype(np.int64).transpose(2, 0, 1)
    fixed = low + 256 * middle + 65536 * high
    words = parts[4].view("<u4").astype(np.int64)
    tens = [words >> shift & 1023 for shift in (20, 10, 0)]
    others = [math.sqrt(0.5) / 511 * np.where(t < 512, t, 512 - t) for t in tens]
    xyzw = _with_largest(words >> 30, np.stack(others, axis=1))
    sh = np.zeros((n, k + 1, 3))
    sh[:, 0] = (parts[2].reshape(n, 3) / 255 - 0.5) / 0.15
    sh[:, 1:] = parts[5].reshape(n, k, 3) / 128 - 1
    splats = _splats(
        means=np.where(fixed < 1 << 23, fixed, fixed - (1 << 24)) / 2**fraction,
        quaternions=np.roll(xyzw, 1, axis=1),
        log_scales=parts[3].reshape(n, 3) / 16 - 10,
        opacity_logits=_logits(parts[1] / 255),
        sh=sh,
    )
    return FileContent(splats, _Y_UP)


def _sog(path: Path) -> FileContent:
    import json
    import zipfile

    from PIL import Image

    with zipfile.ZipFile(path) as package:
        meta = json.loads(package.read("meta.json"))

        def pixels(part: str, number: int = 0) -> NDArray[np.int64]:
            with package.open(meta[part]["files"][number]) as file:
                return np.array(Image.open(file).convert("RGBA"), np.int64)

        def a_splat(part: str, number: int = 0) -> NDArray[np.int64]:
            return pixels(part, number).reshape(-1, 4)[: meta["count"]]

        low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
        part = (a_splat("means")[:, :3] + 256 * a_splat("means", 1)[:, :3]) / 65535
        bent = low * (1 - part) + high * part
        turns, colours = a_splat("quats"), a_splat("sh0")
        sh = np.array(meta["sh0"]["codebook"])[colours[:, None, :3]]
        if "shN" in meta:
            k = (meta["shN"]["bands"] + 1) ** 2 - 1
            halves, palette = a_splat("shN", 1), pixels("shN")[:, :, :3].reshape(-1, k, 3)
            chosen = palette[halves[:, 0] + 256 * halves[:, 1]]
            sh = np.concatenate([sh, np.array(meta["shN"]["codebook"])[chosen]], axis=1)
        splats = _splats(
            means=np.where(bent < 0, -1, 1) * (np.exp(np.abs(bent)) - 1),
            quaternions=_with_largest(turns[:, 3] - 252, (turns[:, :3] / 127.5 - 1) / 2**0.5),
            log_scales=np.array(meta["scales"]["codebook"])[a_splat("scales")[:, :3]],
            opacity_logits=_logits(colours[:, 3] / 255),
            sh=sh,
        )
    return FileContent(splats, np.eye(4))


def _with_largest(column: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N, 4] where `others` [N, 3] leave out the component `column`, which is the largest."""
    quaternions = np.zeros((len(others), 4))
    for k in range(4):
        rows = column == k
        largest = np.sqrt(np.maximum(0, 1 - np.square(others[rows]).sum(axis=1)))
        quaternions[rows] = np.insert(others[rows], k, largest, axis=1)
    return quaternions


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
            _splats(
                means=values(primitive, "POSITION"),
                quaternions=np.roll(xyzw, 1, axis=1),
                log_scales=np.log(values(primitive, f"{prefix}SCALE").astype(np.float64)),
                opacity_logits=_logits(values(primitive, f"{prefix}OPACITY")[:, 0]),
                sh=sh,
            )
        )
    return FileContent(_concatenated(parts), _Y_UP)


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
            _splats(
                means=np.array(get("positions").Get(), np.float32),
                quaternions=np.array(get("orientations").Get(), np.float32)[:, columns],
                log_scales=np.log(np.array(get("scales").Get(), np.float64)),
                opacity_logits=_logits(np.array(get("opacities").Get())),
                sh=sh,
            )
        )
    return FileContent(_concatenated(parts), _Y_UP)


def _logits(p: NDArray[np.floating]) -> NDArray[np.float64]:
    inside = np.clip(p.astype(np.float64), 1e-30, 1 - 1e-9)
    return np.log(inside / (1 - inside))


def _splats(**arrays: NDArray[np.floating]) -> Splats:
    values = {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
    n, k = values["sh"].shape[:2]
    for name, width in {"means": 3, "quaternions": 4, "log_scales": 3}.items():
        values[name] = values[name].reshape(n, width)
    return Splats(**values, sh_degrees=np.full(n, math.isqrt(k) - 1, np.uint8))  # type: ignore[arg-type]


def _concatenated(parts: list[Splats]) -> Splats:
    if not parts:
        shapes = {"means": 3, "quaternions": 4, "log_scales": 3}
        empty = {name: np.zeros((0, width)) for name, width in shapes.items()}
        return _splats(**empty, opacity_logits=np.zeros(0), sh=np.zeros((0, 1, 3)))
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return _splats(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


_READERS = {
    "ply": _ply,
    "splat": _splat,
    "glb": _gltf,
    "gltf": _gltf,
    "usda": _usd,
    "usdc": _usd,
    "usdz": _usd,
    "compressed.ply": _compressed_ply,
    "spz": _spz,
    "sog": _sog,
}
