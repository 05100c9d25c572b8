"""Writes normalised pictures, masks and depth maps."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import replacing
from stages.ingest.masking import MaskedPhoto
from stages.scene import Photo

_JPEG_QUALITY = 95


def write_photo(photo: Photo, masked: MaskedPhoto, folder: Path) -> Photo:
    """Write the picture and the mask of `photo`, relative to `folder`; returns `photo`.

    A JPEG that needed no change keeps its bytes, because encoding it again would lose detail.
    Raises SplatError if they cannot be written.
    """
    target, decoded = folder / photo.image, masked.decoded
    unchanged = None if target.suffix.lower() == ".png" else decoded.unchanged_jpeg
    _write(target, unchanged or _encoded(decoded.pixels, target.suffix))
    if masked.mask is not None:
        _write(folder / photo.mask, _encoded(masked.mask, ".png"))
    return photo


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map [h, w] as .npy. Raises SplatError if it cannot be written."""
    content = io.BytesIO()
    np.lib.format.write_array(content, np.ascontiguousarray(depth), (1, 0), allow_pickle=False)
    _write(path, content.getvalue())


def _encoded(pixels: NDArray[np.uint8], suffix: str) -> bytes:
    """A picture [H, W, 3], or grey [H, W], as PNG or JPEG (4:4:4), by the suffix."""
    content, picture = io.BytesIO(), Image.fromarray(pixels)
    if suffix.lower() == ".png":
        picture.save(content, "PNG", compress_level=3)
    else:
        picture.save(content, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return content.getvalue()


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(content)
