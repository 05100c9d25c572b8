"""A mask of a photograph."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from stages.photos.decode import Decoded
from stages.photos.exif import Exif
from stages.photos.masking import AUTO, MaskedPhoto
from tests.fuzz.layer import Layer

WIDTH, HEIGHT = 48, 32


def _content() -> bytes:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[8:, 5:40] = 255
    out = io.BytesIO()
    Image.fromarray(mask).save(out, "PNG", compress_level=0)
    return out.getvalue()


def _read(path: Path) -> int:
    pixels = np.full((HEIGHT, WIDTH, 3), 99, np.uint8)
    photograph = Decoded(pixels, (WIDTH, HEIGHT), Exif())
    found = MaskedPhoto.of(photograph, "a.jpg", path, False, AUTO)
    assert found.mask is not None
    assert found.mask.shape == (HEIGHT, WIDTH)
    assert found.mask.dtype == np.uint8
    return 1


LAYERS = {"mask.png": Layer("mask.png", _content, read=_read, holds=1)}
