"""Decodes a photograph of any supported format to upright 8-bit sRGB of limited size.

JPEG files are checked first, because decoders accept faults without an error: they fill missing
parts with grey, and go over the whole picture once for each scan, however many a file has.
"""

from __future__ import annotations

import io
import logging
import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageFile, UnidentifiedImageError

from stages.base.text import reason_of
from stages.ingest import colour
from stages.ingest.exif import Exif, read_exif
from stages.ingest.tiff import is_negative, tiff_fault
from stages.scene import fitted_size

MAX_MEGAPIXELS = 200
MAX_FILE_BYTES = 2**31
COPY_AGAIN = "Copy it from the camera again"
EIGHT_OR_SIXTEEN_BITS = "Save it with 8 or 16 bits a sample, channels interleaved"
AS_JPEG = "Save it as JPEG or PNG if it belongs to the capture"
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "HEIF", "AVIF", "BMP")  # MPO opens as JPEG
_SMALLEST_SIDE_PX = 16
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


class Unusable(Exception):  # noqa: N818 - a finding about a file, not a failure
    """A file that cannot be used. The message says why and is printed after "name: ". hint: what to
    do, a sentence without its full stop."""

    def __init__(self, why: str, hint: str = COPY_AGAIN) -> None:
        super().__init__(why)
        self.hint = hint


@dataclass(frozen=True)
class Decoded:
    """A decoded photograph.

    Args:
        pixels: [H, W, 3] uint8 sRGB, upright, of limited size, over black where transparent.
        stored: (width, height) in the file, before it was turned upright.
        exif: what the camera wrote.
        unchanged_jpeg: the bytes of the file, if it is a JPEG of exactly these pixels.
        alpha: [H, W] uint8 opacity; None where all pixels are opaque.
        hdr: whether the file declares a transfer function of high dynamic range.
        bad_profile: whether its ICC profile is damaged.
    """

    pixels: NDArray[np.uint8]
    stored: tuple[int, int]
    exif: Exif
    unchanged_jpeg: bytes | None = None
    alpha: NDArray[np.uint8] | None = None
    hdr: bool = False
    bad_profile: bool = False

    @property
    def upright(self) -> tuple[int, int]:
        """(width, height) of the file, turned upright."""
        width, height = self.stored
        return (height, width) if self.exif.orientation >= 5 else (width, height)  # quarter turns


class PixelBudget:
    """Limits how many pixels threads decode at once."""

    def __init__(self, pixels: int) -> None:
        self._free = self._all = pixels
        self._changed = threading.Condition()

    @contextmanager
    def spend(self, pixels: int) -> Iterator[None]:
        """Waits until `pixels` are free; a picture larger than the budget goes alone."""
        pixels = min(pixels, self._all)
        with self._changed:
            self._changed.wait_for(lambda: self._free >= pixels)
            self._free -= pixels
        try:
            yield
        finally:
            with self._changed:
                self._free += pixels
                self._changed.notify_all()


@contextmanager
def readers_set_up() -> Iterator[None]:
    """HEIC support on, Pillow's own size limit off (ours applies), truncated files refused.

    To be entered once, around all threads: these are settings of the whole process.
    """
    Image.init()
    pillow_heif.register_heif_opener()
    logging.getLogger("PIL").addHandler(logging.NullHandler())  # else errors go to the terminal
    before = Image.MAX_IMAGE_PIXELS, ImageFile.LOAD_TRUNCATED_IMAGES
    log_level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    Image.MAX_IMAGE_PIXELS, ImageFile.LOAD_TRUNCATED_IMAGES = None, False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damaged tags; what matters is found anyway
            yield
    finally:
        Image.MAX_IMAGE_PIXELS, ImageFile.LOAD_TRUNCATED_IMAGES = before
        cv2.utils.logging.setLogLevel(log_level)


def decode(path: Path, max_side: int, budget: PixelBudget) -> Decoded:
    """Read the photograph at `path`, its longer side at most `max_side` pixels.

    Raises Unusable for a file that is damaged, truncated, of another kind, too large or too small.
    """
    data = _read(path)
    readable = [name for name in FORMATS if name in Image.OPEN]  # builds of Pillow differ
    try:
        with Image.open(io.BytesIO(data), formats=readable) as image:
            stored = check_size(image.size)
            with budget.spend(stored[0] * stored[1]):
                return _decode(image, data, max_side)
    except (Unusable, MemoryError):
        raise
    except UnidentifiedImageError as error:
        raise _unidentified(data) from error
    except Exception as error:  # decoders raise whatever the damage leads to
        raise Unusable(f"it does not decode ({reason_of(error)})") from error


def head(path: Path) -> tuple[tuple[int, int], int]:
    """(width, height) as stored and EXIF orientation of the photograph at `path`, as in `Decoded`,
    without its pixels. Raises Unusable."""
    try:
        with Image.open(path, formats=[name for name in FORMATS if name in Image.OPEN]) as image:
            return image.size, _exif_of(image).orientation
    except Exception as error:  # decoders raise whatever the damage leads to
        raise Unusable(f"it does not decode ({reason_of(error)})") from error


def _exif_of(image: Image.Image) -> Exif:
    exif = read_exif(image)
    turned = image.format in ("HEIF", "TIFF")  # the decoder turns the pixels itself
    return replace(exif, orientation=1) if turned else exif


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise Unusable("the file is larger than 2 GiB", "Scale it down")
        data = path.read_bytes()
    except PermissionError as error:
        raise Unusable("permission to read it is denied", "Change its permissions") from error
    except OSError as error:
        raise Unusable(f"it cannot be opened ({error.strerror or error})") from error
    if not data:
        raise Unusable("the file is empty")
    if data[:3] == b"\xff\xd8\xff" and (fault := jpeg_fault(data)):
        raise Unusable(fault)
    return data


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """The size (width, height) of a picture. Raises Unusable if it is too large or too small."""
    if size[0] * size[1] > MAX_MEGAPIXELS * 1_000_000:
        why = f"{size[0]} x {size[1]} is more than {MAX_MEGAPIXELS} megapixels"
        raise Unusable(why, f"Scale it down to {MAX_MEGAPIXELS} megapixels or less")
    if min(size) < _SMALLEST_SIDE_PX:
        raise Unusable(f"{size[0]} x {size[1]} pixels are too few", "Use the original file")
    return size


def _decode(image: Image.Image, data: bytes, max_side: int) -> Decoded:
    stored, exif, info = image.size, _exif_of(image), dict(image.info)
    size = fitted_size(*stored, max_side)
    jpeg = image.format in ("JPEG", "MPO")
    if jpeg and size != stored and image.mode in ("RGB", "L"):
        image.draft(None, (2 * size[0], 2 * size[1]))  # lets the decoder average for us
    native_mode = image.mode
    basic = _resized(_basic_mode(_loaded(image, data)), size, stored)
    black, alpha = _over_black(basic)
    shown, bad_profile = _in_srgb(black, info.get("icc_profile"))
    converted = shown is not black
    upright = exif.orientation == 1
    if not upright:
        shown = shown.transpose(UPRIGHT[exif.orientation])
        alpha = None if alpha is None else alpha.transpose(UPRIGHT[exif.orientation])
    pixels = np.array(shown if shown.mode == "RGB" else shown.convert("RGB"))
    declared = None if info.get("icc_profile") else _declared_space(exif, info)
    if declared is not None:
        pixels, converted = declared(pixels), True
    unchanged = jpeg and size == stored and native_mode in ("RGB", "L") and upright
    return Decoded(
        pixels=pixels,
        stored=stored,
        exif=exif,
        unchanged_jpeg=data if unchanged and not converted else None,
        alpha=np.array(alpha) if alpha is not None else None,
        hdr=colour.nclx_is_hdr(info.get("nclx_profile")),
        bad_profile=bad_profile,
    )


def _declared_space(exif: Exif, info: dict[Any, Any]) -> Any:
    """The conversion for a colour space that Exif or nclx declares without an ICC profile, or
    None."""
    if exif.adobe_rgb:
        return colour.adobe_to_srgb
    return colour.p3_to_srgb if colour.nclx_is_p3(info.get("nclx_profile")) else None


def _loaded(image: Image.Image, data: bytes) -> Image.Image:
    """The decoded picture with 8 bits a sample. Raises what Pillow and OpenCV raise."""
    tags = getattr(image, "tag_v2", {})
    if fault := tiff_fault(tags):
        raise Unusable(fault, EIGHT_OR_SIXTEEN_BITS)
    try:
        image.load()
    except OSError:
        if image.format != "TIFF":
            raise
        return _loaded_by_opencv(data)
    if image.mode.startswith("I"):  # 16-bit grey; older Pillows widen it to 32 bits
        samples = np.asarray(image).astype(np.int64)
        if samples.min() < 0 or samples.max() > 65535:
            raise Unusable("its samples have more than 16 bits", EIGHT_OR_SIXTEEN_BITS)
        return Image.fromarray(_to_8_bit(65535 - samples if is_negative(tags) else samples))
    if image.mode == "F":
        raise Unusable("its samples are floating-point numbers", EIGHT_OR_SIXTEEN_BITS)
    return image


def _loaded_by_opencv(data: bytes) -> Image.Image:
    """For the TIFF variants that Pillow does not read."""
    samples = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if samples is None or samples.dtype not in (np.uint8, np.uint16):
        why = "it does not decode, or its samples do not have 8 or 16 bits"
        raise Unusable(why, EIGHT_OR_SIXTEEN_BITS)
    if samples.dtype == np.uint16:
        samples = _to_8_bit(samples)
    if samples.ndim == 3:
        code = cv2.COLOR_BGRA2RGBA if samples.shape[2] == 4 else cv2.COLOR_BGR2RGB
        samples = cv2.cvtColor(samples, code)
    return Image.fromarray(samples)


def _to_8_bit(samples: NDArray[Any]) -> NDArray[np.uint8]:
    return ((samples.astype(np.uint32) + 128) // 257).astype(np.uint8)


def _basic_mode(image: Image.Image) -> Image.Image:
    """The picture as RGB, L, CMYK, RGBA or LA."""
    if image.mode in ("PA", "RGBa", "La") or "transparency" in image.info:
        return image.convert("RGBA")
    return image if image.mode in ("RGB", "L", "CMYK", "RGBA", "LA") else image.convert("RGB")


def _over_black(image: Image.Image) -> tuple[Image.Image, Image.Image | None]:
    """(the picture over black as RGB or L, its alpha channel if it is transparent anywhere)."""
    if image.mode not in ("RGBA", "LA"):
        return image, None
    mode, alpha = image.mode[:-1], image.getchannel("A")
    if alpha.getextrema() == (255, 255):
        return image.convert(mode), None
    above = image.convert(mode)
    return Image.composite(above, Image.new(mode, image.size), alpha), alpha


def _resized(image: Image.Image, size: tuple[int, int], stored: tuple[int, int]) -> Image.Image:
    """Scaled to `size`. `image` may be a draft of `stored` that was rounded up to whole pixels."""
    if image.size == size:
        return image
    factor = max(1, round(stored[0] / image.width))
    box = (0.0, 0.0, min(stored[0] / factor, image.width), min(stored[1] / factor, image.height))
    return image.resize(size, Image.Resampling.LANCZOS, box=box, reducing_gap=3.0)


def _in_srgb(image: Image.Image, profile: bytes | None) -> tuple[Image.Image, bool]:
    """(the picture in sRGB, itself if nothing changes; whether its profile is damaged)."""
    try:
        return colour.icc_to_srgb(image, profile) if profile else image, False
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image, True


def _unidentified(data: bytes) -> Unusable:
    if data[:4] in (b"II*\0", b"MM\0*"):
        why = "it is damaged, or a TIFF with other samples than integers of 8 or 16 bits"
        return Unusable(why, EIGHT_OR_SIXTEEN_BITS)
    if data[:6] in (b"GIF87a", b"GIF89a"):
        return Unusable("it is a GIF", AS_JPEG)
    if data[:64].isascii() and b"\0" not in data[:64]:
        return Unusable("it holds text, not a picture", "Remove it, or replace it by the picture")
    return Unusable("it is not a picture, or is damaged")


# In a scan's data every FF is followed by 00 (stuffing) or D0-D7 (restart), or it is fill (FF FF).
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_TRUNCATED = "the file is truncated"
_MOST_SCANS = 100  # a progressive JPEG has about ten
_START, _END, _SCAN, _TEM = 0xD8, 0xD9, 0xDA, 0x01


def jpeg_fault(data: bytes) -> str:
    """Why the first image in `data` is refused: it lacks its end-of-image marker (ITU-T T.81, annex
    B), or has very many scans. "" if nothing is wrong.

    Walks over the segments, so that an end marker within a thumbnail or a comment does not count.
    """
    if data[:2] != b"\xff\xd8":
        return _TRUNCATED
    position, scans = 2, 0
    while position + 1 < len(data):
        if data[position] != 0xFF:
            return _TRUNCATED
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _END:
            return ""
        if marker == _TEM or _START > marker >= 0xD0:
            position += 2
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == _SCAN:
            found = _MARKER_IN_SCAN.search(data, position)
            scans += 1
            if scans > _MOST_SCANS:
                return f"it has more than {_MOST_SCANS} scans"
            if found is None:
                return _TRUNCATED
            position = found.end() - 2
    return _TRUNCATED
