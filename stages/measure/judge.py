"""The one judge: photographs, and how far drawings of splats are from them.

Every figure of quality in a run comes from here: the same photographs in 8 bits, at the size that
the splats were fitted at, drawn by the run's backend with the near plane of the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.measure.images import flip, psnr, ssim
from stages.photos.load import load_image, mask_of
from stages.raster.draw import renderer
from stages.scene import IGNORE, TRANSPARENT, Camera, Look, Splats, View

CAP_DB = 99.0  # what "no difference at all" is written as: JSON has no infinity
Drawing = Callable[[Camera], NDArray[np.floating]]  # a picture [H, W, 3]


@dataclass(frozen=True)
class Photograph:
    """One photograph at the size it is judged at: pixels [H, W, 3] uint8, sRGB. mask [H, W],
    outside: as in `scene.Photo`; None where everything counts."""

    name: str
    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None = None
    outside: str = ""

    @property
    def image(self) -> NDArray[np.float32]:
        """[H, W, 3] in [0, 1]."""
        return self.pixels * np.float32(1 / 255)

    @property
    def kept(self) -> NDArray[np.bool_] | None:
        """[H, W] the pixels that are judged, or None for all: what is ignored is not."""
        return self.mask > 0 if self.mask is not None and self.outside == IGNORE else None

    def over(self, grey: float) -> Photograph:
        """A cut-out photograph, which is over black, over `grey` (0 to 1); any other as it is."""
        if self.mask is None or self.outside != TRANSPARENT:
            return self
        behind = (255 - self.mask[..., None]) * np.float32(grey)
        return replace(self, pixels=np.rint(self.pixels + behind).clip(0, 255).astype(np.uint8))


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
        load_photograph(folder, view, look.camera(view.camera)).over(look.background)
        for view in views
    )


def load_photograph(folder: Path, view: View, camera: Camera) -> Photograph:
    """The view's picture in `folder` on the camera's pixel grid, over black where it is cut out.
    Raises SplatError."""
    picture = load_image(folder / view.image, camera.width, camera.height)
    pixels = np.round(picture * 255).astype(np.uint8)
    mask = mask_of(folder, view, camera.width, camera.height)
    if mask is not None and view.outside == TRANSPARENT:
        pixels[mask == 0] = 0  # where JPEG left traces of an edge
    return Photograph(view.name, camera, pixels, mask, view.outside)


def decibels(
    image: NDArray[np.floating],
    truth: NDArray[np.floating],
    kept: NDArray[np.bool_] | None = None,
) -> float:
    """PSNR of what a screen would show of `image`, at most `CAP_DB`; 0 for what is no number. kept
    [H, W]: the pixels that count; None for all."""
    found = psnr(np.clip(image, 0.0, 1.0), truth, kept)
    return 0.0 if np.isnan(found) else min(found, CAP_DB)


def scores(
    draw: Drawing, photographs: Iterable[Photograph], with_flip: bool = False
) -> list[Score]:
    """PSNR, SSIM and perhaps FLIP of each, of drawings clipped to what a screen can show."""
    found = []
    for photograph in photographs:
        image, truth = np.clip(draw(photograph.camera), 0.0, 1.0), photograph.image
        kept = photograph.kept
        seen = flip(image, truth, kept) if with_flip else None
        alike = ssim(image, truth, kept)
        found.append(Score(photograph.name, decibels(image, truth, kept), alike, seen))
    return found


def inside_db(draw: Drawing, photographs: Iterable[Photograph]) -> float | None:
    """Mean PSNR of what is inside the masks of cut-out photographs; None where none is."""
    found = [
        decibels(draw(p.camera), p.image, p.mask > 0)
        for p in photographs
        if p.mask is not None and p.outside == TRANSPARENT
    ]
    return float(np.mean(found)) if found else None


def drawing_of(splats: Splats, backend: str) -> Drawing:
    """What draws `splats` by their own look."""
    draw = renderer(splats, backend=backend)
    return lambda camera: draw(camera).image


def mean_psnr_db(splats: Splats, photographs: Iterable[Photograph], backend: str) -> float:
    """Mean PSNR over the photographs, dB."""
    draw = drawing_of(splats, backend)
    return float(np.mean([decibels(draw(p.camera), p.image, p.kept) for p in photographs]))
