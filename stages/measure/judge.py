"""The one judge: photographs, and how far drawings of splats are from them.

Every figure of quality in a run comes from here: the same photographs in 8 bits, at the size that
the splats were fitted at, drawn by the run's backend with the near plane of the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.measure.images import flip, psnr, ssim
from stages.photos.load import load_image
from stages.raster.draw import renderer
from stages.scene import Camera, Look, Splats, View

CAP_DB = 99.0  # what "no difference at all" is written as: JSON has no infinity
Drawing = Callable[[Camera], NDArray[np.floating]]  # a picture [H, W, 3]


@dataclass(frozen=True)
class Photograph:
    """One photograph at the size it is judged at: pixels [H, W, 3] uint8, sRGB."""

    name: str
    camera: Camera
    pixels: NDArray[np.uint8]

    @property
    def image(self) -> NDArray[np.float32]:
        """[H, W, 3] in [0, 1]."""
        return self.pixels * np.float32(1 / 255)


@dataclass(frozen=True)
class Score:
    """How near one drawing is to its photograph; PSNR at most 99 dB. Definitions in `images`.
    flip: None where it was not asked for; it takes five times as long as the others."""

    name: str
    psnr_db: float
    ssim: float
    flip: float | None = None


def load_photographs(folder: Path, views: Iterable[View], look: Look) -> tuple[Photograph, ...]:
    """The views' photographs at the size of `look`. Raises SplatError."""
    return tuple(
        load_photograph(folder, view.name, view.image, look.camera(view.camera)) for view in views
    )


def load_photograph(folder: Path, name: str, image: str, camera: Camera) -> Photograph:
    """The picture folder / image on the camera's pixel grid. Raises SplatError."""
    picture = load_image(folder / image, camera.width, camera.height)
    return Photograph(name, camera, np.round(picture * 255).astype(np.uint8))


def decibels(image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """PSNR of what a screen would show of `image`, at most `CAP_DB`; 0 for what is no number."""
    found = psnr(np.clip(image, 0.0, 1.0), truth)
    return 0.0 if np.isnan(found) else min(found, CAP_DB)


def scores(
    draw: Drawing, photographs: Iterable[Photograph], with_flip: bool = False
) -> list[Score]:
    """PSNR, SSIM and perhaps FLIP of each, of drawings clipped to what a screen can show."""
    found = []
    for photograph in photographs:
        image, truth = np.clip(draw(photograph.camera), 0.0, 1.0), photograph.image
        seen = flip(image, truth) if with_flip else None
        found.append(Score(photograph.name, decibels(image, truth), ssim(image, truth), seen))
    return found


def drawing_of(splats: Splats, backend: str) -> Drawing:
    """What draws `splats` by their own look."""
    draw = renderer(splats, backend=backend)
    return lambda camera: draw(camera).image


def mean_psnr_db(splats: Splats, photographs: Iterable[Photograph], backend: str) -> float:
    """Mean PSNR over the photographs, dB."""
    draw = drawing_of(splats, backend)
    return float(np.mean([decibels(draw(p.camera), p.image) for p in photographs]))
