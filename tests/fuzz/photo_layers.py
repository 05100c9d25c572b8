"""Photographs and masks."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from stages.ingest.decode import Decoded, PixelBudget, decode, readers_set_up
from stages.ingest.exif import Exif
from stages.ingest.masking import AUTO, MaskedPhoto
from tests.fuzz.layer import Layer
from tests.ingest.made_files import exif, textured

WIDTH, HEIGHT = 48, 32
_MAX_SIDE = 1600


def _saved(kind: str, mode: str = "RGB", **options: Any) -> Callable[[], bytes]:
    def content() -> bytes:
        out = io.BytesIO()
        with readers_set_up():
            picture = Image.fromarray(textured(1, WIDTH, HEIGHT)).convert(mode)
            picture.save(out, kind, **options)
        return out.getvalue()

    return content


def _decoded(path: Path) -> int:
    """As ingest decodes it and uses its Exif."""
    with readers_set_up():
        found = decode(path, _MAX_SIDE, PixelBudget(1 << 28))
    height, width = found.pixels.shape[:2]
    assert max(width, height) <= _MAX_SIDE
    assert found.pixels.shape[2] == 3
    focal, ev = found.exif.focal_px(found.stored, width, height), found.exif.exposure_ev
    assert np.isfinite([focal or 0.0, ev or 0.0]).all()
    assert found.exif.camera_key(width, height)
    return 1


def _photograph(name: str, content: Callable[[], bytes]) -> Layer:
    return Layer(name, content, read=_decoded, holds=1)


def _tags() -> bytes:
    return bytes(exif().tobytes())


def _with_tags(tags: bytes) -> bytes:
    """A JPEG whose Exif these bytes are."""
    whole, tags = _saved("JPEG")(), tags[: (1 << 16) - 3]
    return whole[:2] + b"\xff\xe1" + struct.pack(">H", len(tags) + 2) + tags + whole[2:]


def _profile() -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def _with_profile(profile: bytes) -> bytes:
    return _saved("JPEG", icc_profile=profile)()


def _with_sums(content: bytes) -> bytes:
    """A PNG whose chunks end in their checksums."""
    fitting, at = bytearray(content), 8
    while at + 12 <= len(fitting):
        (size,) = struct.unpack_from(">I", fitting, at)
        end = at + 8 + size
        if end + 4 > len(fitting):
            break
        struct.pack_into(">I", fitting, end, zlib.crc32(fitting[at + 4 : end]))
        at = end + 4
    return bytes(fitting)


def _mask() -> bytes:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[8:, 5:40] = 255
    out = io.BytesIO()
    Image.fromarray(mask).save(out, "PNG", compress_level=0)
    return out.getvalue()


def _read_mask(path: Path) -> int:
    pixels = np.full((HEIGHT, WIDTH, 3), 99, np.uint8)
    photograph = Decoded(pixels, (WIDTH, HEIGHT), Exif())
    found = MaskedPhoto.of(photograph, "a.jpg", path, False, AUTO)
    assert found.mask is not None
    assert found.mask.shape == (HEIGHT, WIDTH)
    assert found.mask.dtype == np.uint8
    return 1


LAYERS = {
    "mask.png": Layer("mask.png", _mask, read=_read_mask, holds=1),
    "photograph, JPEG": _photograph("a.jpg", _saved("JPEG", quality=90, exif=exif())),
    "photograph, progressive": _photograph("a.jpg", _saved("JPEG", progressive=True)),
    "photograph, Exif": Layer("a.jpg", _tags, _with_tags, read=_decoded, holds=1),
    "photograph, colour profile": Layer("a.jpg", _profile, _with_profile, read=_decoded, holds=1),
    "photograph, PNG with fitting sums": Layer(
        "a.png", _saved("PNG", exif=exif()), _with_sums, read=_decoded, holds=1
    ),
    "photograph, PNG": _photograph("a.png", _saved("PNG", compress_level=0, exif=exif())),
    "photograph, PNG of a palette": _photograph("a.png", _saved("PNG", "P", compress_level=0)),
    "photograph, TIFF": _photograph("a.tif", _saved("TIFF", exif=exif())),
    "photograph, TIFF packed": _photograph("a.tif", _saved("TIFF", compression="tiff_lzw")),
    "photograph, WebP": _photograph("a.webp", _saved("WEBP", exif=exif())),
    "photograph, HEIF": _photograph("a.heic", _saved("HEIF", exif=exif())),
    "photograph, BMP": _photograph("a.bmp", _saved("BMP")),
}
