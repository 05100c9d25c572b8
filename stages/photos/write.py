"""Writes normalised pictures, masks and depth maps."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import replacing
from stages.photos.decode import Decoded
from stages.photos.masking import MaskedPhoto
from stages.scene import Photo

_JPEG_QUALITY = 95


def write_photo(photo: Photo, masked: MaskedPhoto, folder: Path) -> Photo:
    """Write the picture and the mask of `photo`, relative to `folder`; returns `photo`. Raises
    SplatError if they cannot be written."""
    target = folder / photo.image
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, masked.decoded)
    if masked.mask is not None:
        write_mask(folder / photo.mask, masked.mask)
    return photo


def write_picture(path: Path, decoded: Decoded) -> None:
    """Write the picture as JPEG (4:4:4) or PNG, by the suffix of `path`.

    A JPEG that needed no change keeps its bytes, because encoding it again would lose detail.
    Raises SplatError if it cannot be written.
    """
    as_png = path.suffix.lower() == ".png"
    data = None if as_png else decoded.unchanged_jpeg
    if data is None:
        encoded = io.BytesIO()
        picture = Image.fromarray(decoded.pixels)
        if as_png:
            picture.save(encoded, "PNG", compress_level=3)
        else:
            picture.save(encoded, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
        data = encoded.getvalue()
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    """Write a mask [H, W] as grey PNG. Raises SplatError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = io.BytesIO()
    Image.fromarray(mask).save(encoded, "PNG", compress_level=3)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getvalue())


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map [h, w] as .npy. Raises SplatError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array(file, np.ascontiguousarray(depth), (1, 0), allow_pickle=False)
