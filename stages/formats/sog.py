"""Writing SOG version 2: a zip of meta.json and lossless WebP images with one pixel a splat.

Positions are 16-bit symmetric logarithms, sign(x) ln(1 + |x|), in two images (low and high bytes).
Rotations are the smallest three of w, x, y, z, with 252 + the index of the largest in alpha. Log
scales and SH of degree 0 are indices into codebooks of 256; opacity is the alpha of the colour. SH
above degree 0 is a label in a palette of at most 65,536 entries, whose image has 64 entries a line
and three bytes a coefficient. Axes as in memory (y down).
Specification: "The SOG Format", developer.playcanvas.com.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base import scratch
from stages.base.atomic import replacing
from stages.base.row_slices import row_slices
from stages.formats import codebook, smallest_three
from stages.formats.json_fields import location_fields
from stages.formats.sog_read import ANTIALIASED, PALETTE_LIMIT, PER_LINE
from stages.formats.values import linear_opacities, unit_quaternions
from stages.scene import Splats, morton

# Log scales beyond this look the same; clipping leaves more codebook entries for the others.
LOG_SCALE_LIMIT = 20.0
_PALETTE_LEAST, _SPLATS_PER_ENTRY = 1024, 4
_DC_LIMIT = 1e4
STEPS = 65535  # of a position, along each axis


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats`.

    Positions stay relative to `splats.origin`, which meta.json holds. Raises SplatError when the
    file cannot be written.
    """
    members = sog_members(splats, morton.morton_order(splats), units)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as package:
        for name, content in members.items():
            _add(package, name, content)


def sog_members(splats: Splats, places: NDArray[np.intp], units: str) -> dict[str, bytes]:
    """The content of meta.json and of each image, by name.

    Args:
        splats: all drawable.
        places: [N] the order in which they are written.
        units: "metres" or "arbitrary".
    """
    degree = int(splats.sh_degrees.max(initial=0))
    splats = splats.with_sh_degree(degree)
    antialias = splats.draw_settings.antialias
    meta: dict[str, Any] = {"version": 2, "count": len(splats), "antialias": antialias}
    if antialias:
        meta["model"] = ANTIALIASED  # as splat-transform writes and reads it
    meta["asset"] = {
        "generator": "splat",
        "units": units,
        **location_fields(splats.origin, splats.place),
    }
    pictures: dict[str, NDArray[np.uint8]] = {}
    for part in (_positions, _shapes, _colours):
        pictures |= part(splats, places, meta)
    if degree and len(splats):
        pictures |= _sh_palette(splats, places, meta)
    content = {"meta.json": json.dumps(meta, allow_nan=False).encode()}
    return content | {name: _webp(pixels) for name, pixels in pictures.items()}


def _add(package: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a member with the earliest time of the zip format, so that equal splats give equal bytes.
    meta.json is compressed; images are compressed already."""
    packing = zipfile.ZIP_DEFLATED if name.endswith(".json") else zipfile.ZIP_STORED
    info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    package.writestr(info, content, compress_type=packing)


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    # exact: keep colours where alpha is 0
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True, method=4)
    return file.getvalue()


def _rounded(book: NDArray[np.float64]) -> list[float]:
    """The codebook with the precision of float32, in half as many characters."""
    return [float(f"{number:.7g}") for number in book]


def _picture(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, channels] nearly square image with sides that are multiples of 4, from rows
    [N, channels]."""
    width = max(4, 4 * math.ceil(math.sqrt(len(rows)) / 4))
    height = max(4, 4 * math.ceil(len(rows) / width / 4))
    pixels = np.zeros((height * width, rows.shape[1]), np.uint8)
    pixels[: len(rows)] = rows
    return pixels.reshape(height, width, -1)


def _positions(
    splats: Splats, places: NDArray[np.intp], meta: dict[str, Any]
) -> dict[str, NDArray[np.uint8]]:
    low, high = position_range(splats.means)
    span = np.where(high > low, high - low, 1.0)
    halves = np.empty((2, len(splats), 3), np.uint8)
    for rows in row_slices(len(splats)):
        steps = np.rint((symmetric_log(splats.means[places[rows]]) - low) / span * STEPS).astype(
            np.uint16
        )
        halves[:, rows] = steps & 255, steps >> 8
    files = ["means_l.webp", "means_u.webp"]
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": files}
    return {name: _picture(half) for name, half in zip(files, halves, strict=True)}


def position_range(means: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """([3], [3]) least and greatest symmetric logarithm on each axis; 0 without splats."""
    if not len(means):
        return np.zeros(3), np.zeros(3)
    # the logarithm is monotonic, so it maps the bounds to the bounds
    return symmetric_log(means.min(axis=0)), symmetric_log(means.max(axis=0))


def symmetric_log(means: NDArray[np.floating]) -> NDArray[np.float64]:
    """Positions on a symmetric logarithmic scale, which is quantised evenly."""
    exact = means.astype(np.float64)
    return np.sign(exact) * np.log1p(np.abs(exact))


def _shapes(
    splats: Splats, places: NDArray[np.intp], meta: dict[str, Any]
) -> dict[str, NDArray[np.uint8]]:
    book = codebook.scalar_codebook(np.clip(splats.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))
    meta["scales"] = {"codebook": _rounded(book), "files": ["scales.webp"]}
    scales, rotations = (np.empty((len(splats), n), np.uint8) for n in (3, 4))
    for rows in row_slices(len(splats)):
        part = splats.take(places[rows])
        scales[rows] = codebook.nearest(book, part.log_scales)
        largest, others = smallest_three.split(unit_quaternions(part.quaternions))
        rotations[rows, :3] = np.rint(255 * smallest_three.fractions_of(others))
        rotations[rows, 3] = 252 + largest
    meta["quats"] = {"files": ["quats.webp"]}
    return {"scales.webp": _picture(scales), "quats.webp": _picture(rotations)}


def _colours(
    splats: Splats, places: NDArray[np.intp], meta: dict[str, Any]
) -> dict[str, NDArray[np.uint8]]:
    book = codebook.scalar_codebook(np.clip(splats.sh[:, 0], -_DC_LIMIT, _DC_LIMIT))
    meta["sh0"] = {"codebook": _rounded(book), "files": ["sh0.webp"]}
    pixels = np.empty((len(splats), 4), np.uint8)
    for rows in row_slices(len(splats)):
        part = splats.take(places[rows])
        pixels[rows, :3] = codebook.nearest(book, part.sh[:, 0])
        pixels[rows, 3] = np.rint(255 * linear_opacities(part))
    return {"sh0.webp": _picture(pixels)}


def palette_size(count: int) -> int:
    """The largest number of palette entries for `count` splats."""
    return min(PALETTE_LIMIT, max(_PALETTE_LEAST, count // _SPLATS_PER_ENTRY))


def palette_of(
    rest: NDArray[np.float32], bits: int = 16
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """(palette [entries, 3K], labels [N]) of coefficients [N, K, 3]; bits: of a label."""
    size = min(palette_size(len(rest)), 1 << bits)
    return codebook.vector_palette(rest.reshape(len(rest), -1), size)


def _sh_palette(
    splats: Splats, places: NDArray[np.intp], meta: dict[str, Any]
) -> dict[str, NDArray[np.uint8]]:
    count = splats.sh.shape[1] - 1
    vectors = scratch.empty((len(splats), count, 3))
    for rows in row_slices(len(splats)):
        vectors[rows] = np.clip(splats.sh[places[rows], 1:], -_DC_LIMIT, _DC_LIMIT)
    palette, labels = palette_of(vectors)
    book = codebook.scalar_codebook(palette)
    book[np.abs(book).argmin()] = 0.0  # keep zero exact
    book.sort()
    lines = -(-len(palette) // PER_LINE)
    centroids = np.zeros((lines * PER_LINE, count, 3), np.uint8)
    centroids[: len(palette)] = codebook.nearest(book, palette).reshape(-1, count, 3)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta["shN"] = {
        "count": len(palette),
        "bands": splats.sh_degree,
        "codebook": _rounded(book),
        "files": files,
    }
    halves = np.zeros((len(labels), 3), np.uint8)
    halves[:, 0], halves[:, 1] = labels & 255, labels >> 8
    pixels = (centroids.reshape(lines, PER_LINE * count, 3), _picture(halves))
    return dict(zip(files, pixels, strict=True))
