"""Fisheye photographs whose colours are the directions that they show."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.cameras.lens import Lens
from stages.scene import Camera, Photo
from stages.sfm.known.pinhole_views import PinholeView

EQUIDISTANT = Lens("fisheye")
LENS = Lens("fisheye", (-0.02, 0.003), tangential=(0.002, -0.001))


def camera(width: int, height: int, field_deg: float) -> Camera:
    """An equidistant fisheye's, that shows so much across its width."""
    focal = width / np.radians(field_deg)
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def shown(taken: Camera, lens: Lens) -> NDArray[np.float64]:
    """[H, W, 3] the unit direction of each pixel; NaN where the lens shows none."""
    x, y = np.meshgrid(np.arange(taken.width) + 0.5, np.arange(taken.height) + 0.5)
    seen = np.stack([(x - taken.cx) / taken.fx, (y - taken.cy) / taken.fy], axis=-1)
    found = lens.directions(seen.reshape(-1, 2))
    return found.reshape(taken.height, taken.width, 3)


def coded(directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[..., 3] the colours of unit directions; black for NaN. None of them is dark."""
    colours = np.round(127.5 + 100.0 * directions)
    return np.where(np.isnan(colours), 0, colours).astype(np.uint8)


def photograph(folder: Path, name: str, pixels: NDArray[np.uint8], **more: object) -> Photo:
    """Written as a PNG, [H, W, 3] RGB."""
    path = folder / "photos" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[..., ::-1])
    size = pixels.shape[1], pixels.shape[0]
    return Photo(name, f"photos/{name}", *size, None, "fisheye", 1.0, -2.0, None, **more)  # type: ignore[arg-type]


def rays(view: PinholeView) -> NDArray[np.float64]:
    """[H, W, 3] the unit direction of each pixel of a view, in the photograph's axes."""
    c = view.camera
    x, y = np.meshgrid(np.arange(c.width) + 0.5 - c.cx, np.arange(c.height) + 0.5 - c.cy)
    at = np.stack([x / c.fx, y / c.fy, np.ones_like(x)], axis=-1) @ view.rotation
    return np.asarray(at / np.linalg.norm(at, axis=-1, keepdims=True))


def picture(path: Path) -> NDArray[np.uint8]:
    """[H, W, 3] RGB."""
    found = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert found is not None
    return np.asarray(found, np.uint8)
