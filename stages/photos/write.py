"""Normalised pictures on disk."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import replacing
from stages.photos.decode import Decoded

_JPEG_QUALITY = 95


def write_picture(path: Path, decoded: Decoded) -> None:
    """Write the picture as the suffix of `path` says: JPEG (4:4:4) or PNG.

    A JPEG that needed no change keeps its bytes: encoding it again would only lose detail. Raises
    SplatError if the disk refuses.
    """
    as_png = path.suffix.lower() == ".png"
    data = None if as_png else decoded.as_it_was
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
    """Write a mask [H, W] as grey PNG. Raises SplatError if the disk refuses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = io.BytesIO()
    Image.fromarray(mask).save(encoded, "PNG", compress_level=3)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getvalue())
