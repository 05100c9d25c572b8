"""Reads SOG version 2, written by this project or by other programs.

Nothing is unpacked to disk. Members are found by their names in meta.json, and sizes are compared
with the number of splats before memory is allocated.
"""

from __future__ import annotations

import io
import json
import math
import struct
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.bad_files import BadFileError
from stages.base.row_slices import row_slices
from stages.formats import smallest_three
from stages.formats.json_fields import agreed, located, numbers, whole
from stages.formats.values import allocate, logits_of
from stages.scene import Splats

PALETTE_LIMIT = 1 << 16
ANTIALIASED = "antialiased"  # a value of `model`
PER_LINE = 64  # entries of the palette in a line of its image
_META_LIMIT_BYTES = 1 << 20
# Real files take 10 bytes a splat. A file that declares more splats than bytes is refused before
# memory is allocated; a small number may all be equal.
_ALWAYS_ALLOWED = 1 << 16
Member = Callable[[Any, int], bytes]  # (name, largest size) -> content, up to a byte longer


def read(path: Path) -> Splats:
    """The splats of a .sog, float32. Raises BadFileError for a damaged file, another version, or a
    missing member."""
    with zipfile.ZipFile(path) as package:
        return Source(in_zip(package), path.stat().st_size).splats()


def units(path: Path) -> str:
    """The units that the meta.json of a .sog declares; "" if it declares none. Raises as `read`."""
    with zipfile.ZipFile(path) as package:
        asset = Source(in_zip(package), path.stat().st_size).meta().get("asset")
    return str(asset.get("units", "")) if isinstance(asset, dict) else ""


def in_zip(package: zipfile.ZipFile) -> Member:
    """A reader of the members of a zip."""

    def member(name: Any, limit: int) -> bytes:
        if not isinstance(name, str) or name not in package.NameToInfo:
            raise BadFileError(f"it does not hold {str(name)[:80]!r}")
        info = package.getinfo(name)
        # Python unpacks the other kinds without a limit, whatever size the directory gives.
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise BadFileError(f"its {name[:80]!r} is packed by another method than deflate")
        if info.file_size > limit:
            raise BadFileError(f"its {name[:80]!r} is too large for what it should hold")
        try:
            with package.open(name) as file:
                return file.read(limit + 1)
        except RuntimeError as error:  # encrypted, or packed in another way
            raise BadFileError(f"its zip cannot be unpacked ({error})") from error

    return member


def in_folder(folder: Path) -> Member:
    """A reader of the files directly in a folder."""

    def member(name: Any, limit: int) -> bytes:
        if not isinstance(name, str) or Path(name).name != name or not (folder / name).is_file():
            raise BadFileError(f"it does not hold {str(name)[:80]!r}")
        with (folder / name).open("rb") as file:
            return file.read(limit + 1)

    return member


@dataclass(frozen=True)
class Source:
    """One asset. member: reads its files; size_bytes: of all of them. Methods raise
    BadFileError."""

    member: Member
    size_bytes: int

    def meta(self) -> dict[str, Any]:
        """meta.json, with its version and a plausible count checked."""
        meta = json.loads(self._member("meta.json", _META_LIMIT_BYTES))
        if not isinstance(meta, dict) or meta.get("version") != 2:
            raise BadFileError("its meta.json is not of SOG version 2")
        whole(meta, "count", most=max(_ALWAYS_ALLOWED, self.size_bytes))
        return meta

    def splats(self) -> Splats:
        meta = self.meta()
        count = meta["count"]
        low, high = (self._pixels(meta, "means", i, count)[:, :3] for i in (0, 1))
        ends = [numbers(_part(meta, "means"), name, 3) for name in ("mins", "maxs")]
        rotations = self._pixels(meta, "quats", 0, count)
        if (rotations[:, 3] < 252).any():
            raise BadFileError("its rotations do not name their largest component")
        colours, scales = (self._pixels(meta, part, 0, count) for part in ("sh0", "scales"))
        books = [numbers(_part(meta, part), "codebook", 256) for part in ("sh0", "scales")]
        palette, labels = self._palette(meta, count)
        splats = allocate(count, math.isqrt(1 + palette.shape[1]) - 1)
        splats = located(splats, meta.get("asset"))
        splats = splats.with_antialias(antialias_of(meta))
        for rows in row_slices(count):
            out = splats.take(rows)
            steps = (low[rows] + 256.0 * high[rows]) / 65535
            encoded = ends[0] + (ends[1] - ends[0]) * steps
            others = smallest_three.from_fractions(rotations[rows, :3] / 255.0)
            with np.errstate(over="ignore", invalid="ignore"):
                out.means[:] = symmetric_exp(encoded)
                out.sh[:, 0] = books[0][colours[rows, :3]]
                out.log_scales[:] = books[1][scales[rows, :3]]
            out.quaternions[:] = smallest_three.join(
                rotations[rows, 3].astype(np.intp) - 252, others
            )
            out.opacity_logits[:] = logits_of(colours[rows, 3] / 255.0)
            out.sh[:, 1:] = palette[labels[rows]]
        return splats

    def _palette(
        self, meta: dict[str, Any], count: int
    ) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """(SH above degree 0 [entries, K, 3], the label of each splat [N])."""
        none = np.zeros((1, 0, 3), np.float32), np.zeros(count, np.intp)
        if "shN" not in meta:
            return none
        entries = whole(_part(meta, "shN"), "count", most=PALETTE_LIMIT)
        degree = whole(_part(meta, "shN"), "bands", most=3)
        k = (degree + 1) ** 2 - 1
        if not degree:
            return none
        book = numbers(_part(meta, "shN"), "codebook", 256).astype(np.float32)
        lines = -(-entries // PER_LINE)
        indices = self._pixels(meta, "shN", 0, lines * PER_LINE * k, width=PER_LINE * k)
        halves = self._pixels(meta, "shN", 1, count)
        labels = halves[:, 0] + 256 * halves[:, 1].astype(np.intp)
        if len(labels) and labels.max() >= entries:
            raise BadFileError("its splats refer to SH that is not in its palette")
        return book[indices[:, :3].reshape(-1, k, 3)], labels

    def _member(self, name: Any, limit: int) -> bytes:
        """One of its files. Raises BadFileError if it is missing or larger than `limit`."""
        content = self.member(name, limit)
        if len(content) > limit:
            raise BadFileError(f"its {name[:80]!r} is too large for what it should hold")
        return content

    def _pixels(
        self, meta: dict[str, Any], part: str, number: int, count: int, width: int = 0
    ) -> NDArray[np.uint8]:
        """[count, 4] the first pixels of an image in row-major order."""
        files = _part(meta, part).get("files")
        if not isinstance(files, list) or len(files) <= number:
            raise BadFileError(f"its meta.json names no picture {number} of {part}")
        most = 4 * count + 4096
        content = self._member(files[number], 8 * most + 65536)
        size = _webp_size(content)
        if size[0] * size[1] < count or size[0] * size[1] > most or (width and size[0] != width):
            raise BadFileError(f"its picture of {part} has {size[0]} x {size[1]} pixels")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(content), formats=("WEBP",)) as image:
                    if image.size != size:
                        raise BadFileError(f"its picture of {part} is damaged")
                    pixels = np.asarray(image.convert("RGBA"))
        except (OSError, Image.DecompressionBombError, SyntaxError) as error:
            raise BadFileError(f"its picture of {part} is damaged") from error
        return pixels.reshape(-1, 4)[:count]


def symmetric_exp(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of their symmetric logarithms, see `sog.symmetric_log`."""
    return np.sign(encoded) * np.expm1(np.abs(encoded))


def _webp_size(content: bytes) -> tuple[int, int]:
    """(width, height) from the header, before a decoder allocates memory."""
    kind = content[12:16] if content[:4] == b"RIFF" and content[8:12] == b"WEBP" else b""
    if kind == b"VP8L" and len(content) >= 25:
        bits = struct.unpack_from("<I", content, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X" and len(content) >= 30:
        return tuple(1 + int.from_bytes(content[i : i + 3], "little") for i in (24, 27))  # type: ignore[return-value]
    raise BadFileError("its pictures are not lossless WebP")


def _part(meta: dict[str, Any], name: str) -> dict[str, Any]:
    part = meta.get(name)
    if not isinstance(part, dict):
        raise BadFileError(f"its meta.json lacks {name}")
    return part


def antialias_of(meta: dict[str, Any]) -> bool:
    """Whether meta.json asks for opacity compensation: `antialias` of the specification, `model` of
    splat-transform."""
    said = [bool(meta["antialias"])] if "antialias" in meta else []
    said += [meta["model"] == ANTIALIASED] if "model" in meta else []
    return agreed(said, "its meta.json contradicts itself: antialias and model disagree")
