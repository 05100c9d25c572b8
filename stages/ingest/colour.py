"""Converts pictures of other colour spaces to sRGB, by ICC profile, nclx code points or Exif."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from stages.scene.light import linear_light

P3 = 12  # ITU-T H.273: SMPTE EG 432-1 (Display P3)
HDR_TRANSFERS = (16, 18)  # PQ, HLG
# Linear RGB to linear sRGB; both spaces have the white point D65. From the primaries in
# SMPTE EG 432-1 and in Adobe RGB (1998) Color Image Encoding, section 4.3.
P3_TO_SRGB = np.array(
    [[1.22494018, -0.22494018, 0.0], [-0.04205695, 1.04205695, 0.0],
     [-0.01963755, -0.07863605, 1.09827360]]
)  # fmt: skip
_ADOBE_TO_SRGB = np.array(
    [[1.39835574, -0.39835574, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04292899, 1.04292899]]
)
_ADOBE_GAMMA = 563 / 256


def icc_to_srgb(image: Image.Image, profile: bytes) -> Image.Image:
    """`image` in sRGB; itself if that changes nothing. Grey and CMYK pictures become RGB.

    A grey picture may have a profile of RGB. Raises ImageCms.PyCMSError for a profile that is
    damaged, or made for another colour mode.
    """
    mode = image.mode
    if mode == "L" and profile[16:20] == b"RGB ":  # ICC.1:2022, 7.2.8: space of the data
        mode = "RGB"
    transform = _transform(profile, mode)
    if transform is None:
        return image
    converted = ImageCms.applyTransform(image.convert(mode), transform)
    assert converted is not None
    converted.info.pop("icc_profile", None)
    return converted


@lru_cache(maxsize=32)
def _transform(profile: bytes, mode: str) -> Any:
    """The transform to sRGB, or None if it changes no colour by more than 1 of 255."""
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    transform = ImageCms.buildTransform(
        source,
        ImageCms.createProfile("sRGB"),
        mode,
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    if mode not in ("RGB", "L"):
        return transform
    steps = np.linspace(0, 255, 9).round().astype(np.uint8)
    patches: NDArray[np.uint8]
    if mode == "RGB":
        patches = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(9, 81, 3)
    else:
        patches = np.arange(256, dtype=np.uint8).reshape(16, 16)
    moved = ImageCms.applyTransform(Image.fromarray(patches), transform)
    before = patches if mode == "RGB" else patches[..., None]
    shift = np.abs(np.asarray(moved, np.int16) - before.astype(np.int16))
    return transform if shift.max() > 1 else None


def nclx_is_p3(nclx: dict[str, Any] | None) -> bool:
    """Whether the nclx box of a HEIF file without ICC profile declares Display P3."""
    return nclx is not None and int(nclx.get("color_primaries", 1)) == P3


def nclx_is_hdr(nclx: dict[str, Any] | None) -> bool:
    """Whether the nclx box declares a transfer function of high dynamic range, PQ or HLG."""
    return nclx is not None and int(nclx.get("transfer_characteristics", 13)) in HDR_TRANSFERS


def p3_to_srgb(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Display P3 [H, W, 3] to sRGB; colours outside sRGB are clipped."""
    return _convert(pixels, linear_light(np.arange(256) / 255), P3_TO_SRGB)


def adobe_to_srgb(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Adobe RGB (1998) [H, W, 3] to sRGB; colours outside sRGB are clipped."""
    return _convert(pixels, (np.arange(256) / 255) ** _ADOBE_GAMMA, _ADOBE_TO_SRGB)


def _convert(
    pixels: NDArray[np.uint8], decoded: NDArray[np.floating], matrix: NDArray[np.floating]
) -> NDArray[np.uint8]:
    out = np.empty_like(pixels)
    table, weights = decoded.astype(np.float32), matrix.T.astype(np.float32)
    for top in range(
        0, len(pixels), 256
    ):  # strips: a float copy of the whole picture would be large
        linear = np.clip(table[pixels[top : top + 256]] @ weights, 0, 1)
        out[top : top + 256] = np.round(srgb_encoded(linear) * 255)
    return out


def srgb_encoded(linear: NDArray[Any]) -> NDArray[Any]:
    """The sRGB transfer function (IEC 61966-2-1); the inverse of `linear_light`."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def luminance(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[H, W] relative linear luminance of sRGB pixels (ITU-R BT.709 weights)."""
    linear = linear_light(np.arange(256) / 255).astype(np.float32)[pixels]
    return linear @ np.array([0.2126, 0.7152, 0.0722], np.float32)
