"""Small photographs made for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational


def textured(seed: int = 0, width: int = 96, height: int = 64) -> NDArray[np.uint8]:
    """[H, W, 3] blotches and fine grain, different for each seed."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.random((5, 7, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(rng.random((height, width, 3)), (0, 0), 0.7)
    return np.clip((0.75 * coarse + 0.5 * fine) * 200 + 10, 0, 255).astype(np.uint8)


def exif(**tags: Any) -> Image.Exif:
    """Tags of a camera; keywords replace or (None) remove: see `_IDS`."""
    values: dict[str, Any] = {
        "make": "Maker", "model": "Camera 7", "focal": IFDRational(50, 10), "focal_35mm": 36,
        "exposure": IFDRational(1, 100), "f_number": IFDRational(4), "iso": 100,
    }  # fmt: skip
    values.update(tags)
    out = Image.Exif()
    details = out.get_ifd(0x8769)
    for name, value in values.items():
        if value is not None:
            number = _IDS[name]
            (out if number < 0x8000 else details)[number] = value
    return out


_IDS = {
    "make": 0x010F, "model": 0x0110, "orientation": 0x0112, "exposure": 0x829A,
    "f_number": 0x829D, "iso": 0x8827, "focal": 0x920A, "width": 0xA002, "height": 0xA003,
    "plane_x": 0xA20E, "plane_unit": 0xA210, "focal_35mm": 0xA405,
}  # fmt: skip


def save(path: Path, pixels: NDArray[Any], **options: Any) -> Path:
    """Save with Pillow, making folders as needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def folder_of(folder: Path, count: int = 3, **options: Any) -> Path:
    """A folder of `count` different JPEG photographs IMG_1.jpg, ... with EXIF."""
    for number in range(1, count + 1):
        save(folder / f"IMG_{number}.jpg", textured(number), exif=exif(), quality=95, **options)
    return folder
