"""Independent readers of the packed formats: plyfile, gzip, zstandard, zipfile and Pillow, and our
arithmetic. They share no code with `stages.formats`."""

from __future__ import annotations

import gzip
import io
import itertools
import json
import math
import struct
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData

from stages.formats.values import concatenate
from stages.proof.content import (
    NotCrossCheckedError,
    logits,
    says_antialiased,
    splats_by_rows,
    splats_of,
)
from stages.scene import Splats


def compressed_ply(path: Path) -> Splats:
    data = PlyData.read(str(path), mmap="c")
    ranges, rest = data["chunk"], data["sh"].data if "sh" in data else np.zeros(0, "u1")
    names = rest.dtype.names or ()
    per_channel = len(names) // 3
    axes = [("x", 21, 11), ("y", 11, 10), ("z", 0, 11)]

    def values_of(rows: slice) -> dict[str, NDArray[np.floating]]:
        words = data["vertex"].data[rows]
        chunk = np.arange(rows.start, rows.start + len(words)) // 256

        def unpacked(name: str, columns: list[tuple[str, int, int]]) -> NDArray[np.float64]:
            """columns: (suffix of the range's names, lowest bit, bits)."""
            parts = []
            for suffix, shift, bits in columns:
                fraction = (words[name].astype(np.int64) >> shift) % 2**bits / (2**bits - 1)
                if "min_" + suffix not in ranges.data.dtype.names:  # of colours, in old files
                    parts.append(fraction)
                    continue
                low, high = (ranges[e + suffix].astype(float)[chunk] for e in ("min_", "max_"))
                parts.append(low * (1 - fraction) + high * fraction)
            return np.stack(parts, axis=1)

        rotations = words["packed_rotation"].astype(np.int64)
        others = [
            ((rotations >> shift) % 1024 / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)
        ]
        colours = unpacked("packed_color", [("r", 24, 8), ("g", 16, 8), ("b", 8, 8)])
        sh = np.zeros((len(words), per_channel + 1, 3), np.float32)
        sh[:, 0] = (colours - 0.5) * math.sqrt(4 * math.pi)
        for i, name in enumerate(names):
            sh[:, 1 + i % per_channel, i // per_channel] = (rest[name][rows] + 0.5) / 32 - 4
        return {
            "means": unpacked("packed_position", axes),
            "quaternions": _with_largest(rotations >> 30, np.stack(others, axis=1)),
            "log_scales": unpacked("packed_scale", [("scale_" + s, low, n) for s, low, n in axes]),
            "opacity_logits": logits(words["packed_color"].astype(np.int64) % 256 / 255),
            "sh": sh,
        }

    splats = splats_by_rows(data["vertex"].count, values_of)
    return splats.with_antialias(says_antialiased(data.comments))


def spz(path: Path) -> Splats:
    return spz_content(path.read_bytes())


def spz_content(packed: bytes) -> Splats:
    content = _joined(packed) if packed.startswith(b"NGSP") else gzip.decompress(packed)
    magic, version, n, degree, fraction, flags = struct.unpack_from("<IIIBBB", content)
    assert magic == 0x5053474E, "the header does not begin with NGSP"
    assert version in (2, 3, 4), f"the version is {version}, not 2, 3 or 4"
    k = (degree + 1) ** 2 - 1
    turn_bytes = 3 if version == 2 else 4
    ends = 16 + np.cumsum([0, 9 * n, n, 3 * n, 3 * n, turn_bytes * n, 3 * k * n])
    assert len(content) == ends[-1], "the length is not that of the header"
    parts = [
        np.frombuffer(content, np.uint8, b - a, a).reshape(n, (b - a) // max(1, n))
        for a, b in itertools.pairwise(ends.tolist())
    ]

    def values_of(rows: slice) -> dict[str, NDArray[np.floating]]:
        places, alphas, colours, sizes, rotations, rest = (part[rows] for part in parts)
        low, middle, high = places.reshape(-1, 3, 3).astype(np.int64).transpose(2, 0, 1)
        fixed = low + 256 * middle + 65536 * high
        sh = np.zeros((len(alphas), min(k, 15) + 1, 3), np.float32)
        sh[:, 0] = (colours.reshape(-1, 3) / 255 - 0.5) / 0.15
        sh[:, 1:] = rest.reshape(len(alphas), k, 3)[:, :15] / 128 - 1
        xyzw = _xyz_in_bytes(rotations) if version == 2 else _smallest_three(rotations)
        return {
            "means": np.where(fixed < 1 << 23, fixed, fixed - (1 << 24)) / 2**fraction,
            "quaternions": np.roll(xyzw, 1, axis=1),
            "log_scales": sizes.reshape(-1, 3) / 16 - 10,
            "opacity_logits": logits(alphas.reshape(-1) / 255),
            "sh": sh,
        }

    return splats_by_rows(n, values_of).with_antialias(flags & 1 == 1)


def ksplat(path: Path) -> Splats:
    content = path.read_bytes()
    sections, level = content[4], content[20]
    low, high = struct.unpack_from("<ff", content, 36)
    low, high = low or -1.5, high or 1.5
    at, parts = 4096 + 1024 * sections, []
    for number in range(sections):
        numbers = np.frombuffer(content, "<u4", 11, 4096 + 1024 * number).tolist()
        n, room, size, buckets, _, _, steps, _, full, others, degree = numbers
        (block,) = struct.unpack_from("<f", content, 4096 + 1024 * number + 16)
        lengths = [size] * full + np.frombuffer(content, "<u4", others, at).tolist()
        centres = np.frombuffer(content, "<f4", 3 * buckets, at + 4 * others).reshape(-1, 3)
        k = (degree + 1) ** 2 - 1
        widths = ((12, 12, 16, 4, 12 * k), (6, 6, 8, 4, 6 * k), (6, 6, 8, 4, 3 * k))[level]
        at += 4 * others + 12 * buckets
        rows = np.frombuffer(content, np.uint8, sum(widths) * room, at).reshape(room, -1)[:n]
        at += sum(widths) * room
        columns = np.split(rows, np.cumsum(widths)[:-1], axis=1)
        kinds = (["<f4"] * 3, ["<u2", "<f2", "<f2"], ["<u2", "<f2", "<f2"])[level]
        places, sizes, turns = (
            np.ascontiguousarray(column).view(kind).astype(np.float64)
            for column, kind in zip(columns[:3], kinds, strict=True)
        )
        if level:
            places = (places / steps - 1) * block / 2 + np.repeat(centres, lengths, axis=0)
        colours = columns[3] / 255
        rest = np.ascontiguousarray(columns[4]).view(("<f4", "<f2", "u1")[level]).astype(float)
        rest = low + (high - low) * rest / 255 if level == 2 else rest
        sh = np.zeros((n, k + 1, 3))
        sh[:, 0] = (colours[:, :3] - 0.5) * math.sqrt(4 * math.pi)
        for c in range(3 * k):
            channel, i = (c // 3, 1 + c % 3) if c < 9 else ((c - 9) // 5, 4 + (c - 9) % 5)
            sh[:, i, channel] = rest[:, c]
        parts.append(
            splats_of(
                means=places,
                quaternions=turns,
                log_scales=np.log(sizes),
                opacity_logits=logits(colours[:, 3]),
                sh=sh,
            )
        )
    return concatenate(parts)


def _joined(whole: bytes) -> bytes:
    """A file of version 4 in the layout of version 3: the first 16 bytes, then all arrays."""
    (table,) = struct.unpack_from("<I", whole, 16)
    if table != 32:
        raise NotCrossCheckedError("extensions of SPZ 4")
    start = table + 16 * whole[15]
    parts = [whole[:16]]
    for packed, size in struct.iter_unpack("<QQ", whole[table:start]):
        frame = whole[start : start + packed]
        parts.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=size))
        start += packed
    assert start == len(whole), "the length is not that of the table"
    return b"".join(parts)


def _xyz_in_bytes(parts: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[N, 4] x, y, z, w from x, y, z in bytes; w completes the norm to 1 and is not negative."""
    xyz = parts.reshape(-1, 3).astype(np.float64) * 2 / 255 - 1
    return np.insert(xyz, 3, np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1))), axis=1)


def _smallest_three(parts: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[N, 4] x, y, z, w: 2 bits name the largest component; sign and 9 bits for each other."""
    words = np.ascontiguousarray(parts).view("<u4").reshape(-1).astype(np.int64)
    tens = [words >> shift & 1023 for shift in (20, 10, 0)]
    others = [math.sqrt(0.5) / 511 * np.where(t < 512, t, 512 - t) for t in tens]
    return _with_largest(words >> 30, np.stack(others, axis=1))


def streamed_sog(path: Path) -> Splats:
    """The finest level, leaves in the order of their chunks and rows."""
    meta = json.loads(path.read_text("utf-8"))
    if meta.get("environment") or not all(n.endswith("/meta.json") for n in meta["filenames"]):
        raise NotCrossCheckedError("an environment, or chunks that are not folders")
    waiting, leaves = [meta["tree"]], {}
    while waiting:
        node = waiting.pop()
        waiting.extend(node.get("children", ()))
        if node.get("lods"):
            at = node["lods"][sorted(node["lods"], key=int)[0]]
            leaves[at["file"], at["offset"]] = at["count"]
    chunks: dict[int, Splats] = {}
    parts = []
    for (file, offset), count in sorted(leaves.items()):
        if file not in chunks:
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w") as package:
                for part in (path.parent / meta["filenames"][file]).parent.iterdir():
                    package.write(part, part.name)
            chunks[file] = sog(packed)
        parts.append(chunks[file].take(slice(offset, offset + count)))
    return concatenate(parts)


def sog(path: Path | BinaryIO) -> Splats:
    with zipfile.ZipFile(path) as package:
        meta = json.loads(package.read("meta.json"))

        def pixels(part: str, number: int = 0) -> NDArray[np.uint8]:
            with package.open(meta[part]["files"][number]) as file:
                return np.array(Image.open(file).convert("RGBA"))

        def per_splat(part: str, number: int = 0) -> NDArray[np.uint8]:
            return pixels(part, number).reshape(-1, 4)[: meta["count"]]

        lows, highs = per_splat("means"), per_splat("means", 1)
        rotations, colours, sizes = per_splat("quats"), per_splat("sh0"), per_splat("scales")
        k, palette, halves = 0, np.zeros((1, 0, 3), np.uint8), np.zeros_like(rotations)
        if "shN" in meta:
            k = (meta["shN"]["bands"] + 1) ** 2 - 1
            halves, palette = per_splat("shN", 1), pixels("shN")[:, :, :3].reshape(-1, k, 3)
    low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
    books = {part: np.array(meta[part]["codebook"]) for part in ("sh0", "scales")}
    book = np.array(meta["shN"]["codebook"]) if k else np.zeros(256)

    def values_of(rows: slice) -> dict[str, NDArray[np.floating]]:
        part = (lows[rows, :3] + 256.0 * highs[rows, :3]) / 65535
        encoded = low * (1 - part) + high * part
        sh = np.zeros((len(encoded), k + 1, 3), np.float32)
        sh[:, 0] = books["sh0"][colours[rows, :3]]
        sh[:, 1:] = book[palette[halves[rows, 0] + 256 * halves[rows, 1].astype(np.int64)]]
        others = (rotations[rows, :3] / 127.5 - 1) / 2**0.5
        return {
            "means": np.where(encoded < 0, -1, 1) * (np.exp(np.abs(encoded)) - 1),
            "quaternions": _with_largest(rotations[rows, 3].astype(np.int64) - 252, others),
            "log_scales": books["scales"][sizes[rows, :3]],
            "opacity_logits": logits(colours[rows, 3] / 255),
            "sh": sh,
        }

    antialias = meta.get("antialias", meta.get("model") == "antialiased")
    return splats_by_rows(meta["count"], values_of).with_antialias(antialias)


def _with_largest(column: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N, 4] unit quaternions. column [N]: the index of the largest component; others [N, 3]: the
    other components in their order."""
    quaternions = np.zeros((len(others), 4))
    for k in range(4):
        rows = column == k
        largest = np.sqrt(np.maximum(0, 1 - np.square(others[rows]).sum(axis=1)))
        quaternions[rows] = np.insert(others[rows], k, largest, axis=1)
    return quaternions
