"""A little scene with its photographs, drawn by the reference rasteriser's definition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from stages.raster.draw import render
from stages.scene import Camera, Reconstruction, Splats, View, look_at


@dataclass(frozen=True)
class SmallScene:
    """splats: the truth; a tenth of them changes colour with the view (degree 2)."""

    splats: Splats
    reconstruction: Reconstruction


def small_scene(folder: Path, views: int = 10, n: int = 250, noise: float = 0.02) -> SmallScene:
    """A ball of splats seen by `views` cameras around it; photographs 72 x 54 with a little noise.

    The noise bounds the PSNR, as it is in photographs.
    """
    rng = np.random.default_rng(11)
    sh = np.zeros((n, 9, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.5, 1.5, (n, 3))
    shiny = np.arange(n) % 10 == 0
    sh[shiny, 1:] = rng.normal(0, 0.25, (shiny.sum(), 8, 3))
    splats = Splats(
        means=rng.normal(0, 0.5, (n, 3)).astype(np.float32),
        quaternions=rng.normal(0, 1, (n, 4)).astype(np.float32),
        log_scales=rng.normal(-2.3, 0.4, (n, 3)).astype(np.float32),
        opacity_logits=rng.normal(1, 1, n).astype(np.float32),
        sh=sh,
        sh_degrees=np.full(n, 2, np.uint8),
    )
    made = []
    for i in range(views):
        angle = 2 * np.pi * i / views
        eye = np.array([3 * np.cos(angle), -1.0, 3 * np.sin(angle)])
        camera = Camera(72, 54, 80.0, 80.0, 36.0, 27.0, look_at(eye, np.zeros(3)))
        image = render(splats, camera).image + rng.normal(0, noise, (54, 72, 3))
        name = f"{i:02d}.png"
        Image.fromarray(np.uint8(np.clip(image, 0, 1) * 255 + 0.5)).save(folder / name)
        made.append(View(name, name, camera))
    none = np.zeros(0)
    reconstruction = Reconstruction(
        folder=folder,
        views=tuple(made),
        points=np.zeros((0, 3)),
        colours=np.zeros((0, 3), np.uint8),
        errors_px=none,
        tracks=none.astype(np.int32),
        origin=np.array([5e5, 0.0, -4.0]),
        units="metres",
    )
    return SmallScene(splats, reconstruction)
