"""Loads normalised photographs and masks as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base.errors import RunFolderError, SplatError
from stages.base.text import reason_of
from stages.scene.capture import TRANSPARENT, View


def load_image(path: Path, width: int, height: int) -> NDArray[np.float32]:
    """[height, width, 3] float32 RGB in [0, 1], sRGB values as stored.

    Scaled down by averaging over the area of each new pixel, which is what `Camera.resized`
    assumes (pixel centres at +0.5); grey becomes RGB and alpha is dropped. Raises SplatError
    "photo-unreadable" for a file that is missing or does not decode.
    """
    try:
        # Not cv2.imread: it cannot open non-ASCII names on Windows.
        encoded = np.fromfile(path, np.uint8)
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
        image = cv2.imdecode(encoded, flags) if encoded.size else None
    except (OSError, cv2.error) as error:
        raise _unreadable(path, reason_of(error)) from error
    if image is None:
        raise _unreadable(path, "it does not decode as an image")
    full = {"uint8": 255.0, "uint16": 65535.0}.get(image.dtype.name)
    if full is None:
        raise _unreadable(path, f"its samples are {image.dtype}, not 8 or 16 bit integers")
    pixels: NDArray[Any] = image.astype(np.float32) / np.float32(full)
    scaled = scaled_image(pixels, width, height)
    return np.ascontiguousarray(np.clip(scaled, 0.0, 1.0), dtype=np.float32)


def scaled_image(pixels: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """[height, width, ...] means of `pixels` over the area of each new pixel."""
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))


def load_mask(path: Path, width: int, height: int, outside: str) -> NDArray[np.uint8]:
    """[height, width] a mask as ingest and structure from motion write it; 0 is outside.

    It is scaled down as `load_image` does. A transparent photograph keeps its mean opacity in each
    new pixel; where the outside is ignored, a new pixel that holds any of it is ignored. Raises
    SplatError "photo-unreadable".
    """
    return _mask_values(load_image(path, width, height)[..., 0], outside)


def scaled_mask(
    mask: NDArray[np.uint8], width: int, height: int, outside: str
) -> NDArray[np.uint8]:
    """[height, width] `mask` at a smaller size, as `load_mask` scales it."""
    return _mask_values(scaled_image(mask * np.float32(1 / 255), width, height), outside)


def _mask_values(shares: NDArray[np.float32], outside: str) -> NDArray[np.uint8]:
    """A mask in 8 bits from the share of each pixel that is inside."""
    mask = np.round(shares * 255).astype(np.uint8)
    return mask if outside == TRANSPARENT else np.where(mask == 255, mask, np.uint8(0))


def mask_of(folder: Path, view: View, width: int, height: int) -> NDArray[np.uint8] | None:
    """A view's mask, see `load_mask`; None where everything counts."""
    return load_mask(folder / view.mask, width, height, view.outside) if view.mask else None


def load_depth(path: Path) -> NDArray[np.float32]:
    """[h, w] a depth map as ingest and structure from motion write it: z, 0 where nothing was
    measured. Raises SplatError "photo-unreadable"."""
    try:
        depth = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise _unreadable(path, reason_of(error)) from error
    if depth.ndim != 2 or depth.dtype != np.float32:
        raise _unreadable(path, "it is no depth map")
    return np.asarray(depth)


def _unreadable(path: Path, reason: str) -> SplatError:
    return RunFolderError(
        "photo-unreadable",
        given=f"{path} cannot be read: {reason}.",
        wanted="A picture as an earlier stage wrote it.",
        hint="Delete the folder of the stage that wrote it and run the command again.",
    )
