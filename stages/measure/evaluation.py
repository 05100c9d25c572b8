"""The one judge: photographs, and how far drawings of splats are from them.

Every figure of quality in a run comes from here: the same photographs in 8 bits, at the size that
the splats were fitted at, drawn by the run's backend with the near plane of the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from stages.measure.image_metrics import flip, psnr, ssim
from stages.photos.load import load_image, mask_of
from stages.raster.draw import renderer
from stages.scene import IGNORE, TRANSPARENT, Camera, DrawSettings, Splats, View
from stages.scene.light import BRIGHT, Light, gains_and_offsets

IDENTICAL_DB = 99.0  # what "no difference at all" is written as: JSON has no infinity
IN_MEMORY_MIB = 512  # of photographs that judge; more of them are read anew each time
LARGEST_SUBSET = (
    24  # of many judges, those that are worth FLIP's time, or a place where all are seen
)
ImageRenderer = Callable[[Camera], NDArray[np.floating]]  # a picture [H, W, 3]


@dataclass(frozen=True)
class EvaluationView:
    """One photograph at the size it is judged at: pixels [H, W, 3] uint8, sRGB. mask [H, W],
    outside: as in `scene.Photo`; None where everything counts. cut_off [H, W]: where a channel was
    too bright for the picture to tell; not judged either."""

    name: str
    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None = None
    outside: str = ""
    cut_off: NDArray[np.bool_] | None = None

    @property
    def image(self) -> NDArray[np.float32]:
        """[H, W, 3] in [0, 1]."""
        return self.pixels * np.float32(1 / 255)

    @property
    def kept(self) -> NDArray[np.bool_] | None:
        """[H, W] the pixels that are judged, or None for all: what is ignored is not."""
        kept = self.mask > 0 if self.mask is not None and self.outside == IGNORE else None
        if self.cut_off is None:
            return kept
        return ~self.cut_off if kept is None else kept & ~self.cut_off

    def in_median_light(self, light: Light | None) -> EvaluationView:
        """As the median photograph would show it; see `scene.light`."""
        if light is None:
            return self
        gains, offsets = gains_and_offsets(light)
        cut_out = self.mask if self.outside == TRANSPARENT else None
        solid = np.float32(1) if cut_out is None else cut_out[..., None] * np.float32(1 / 255)
        even = (self.image - offsets * solid) / gains
        pixels = np.rint(even * 255).clip(0, 255).astype(np.uint8)
        return replace(self, pixels=pixels, cut_off=np.asarray((self.image >= BRIGHT).any(2)))

    def over(self, grey: float) -> EvaluationView:
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


class _Photographs(Sequence[EvaluationView]):
    """The first of them in memory, the others on disk."""

    def __init__(self, folder: Path, views: Iterable[View], draw_settings: DrawSettings) -> None:
        self._folder, self._views, self._look = folder, tuple(views), draw_settings
        self._kept: list[EvaluationView] = []
        free = IN_MEMORY_MIB * 2**20
        for number, view in enumerate(self._views):
            camera = draw_settings.camera(view.camera)
            free -= 4 * camera.width * camera.height  # three colours and perhaps a mask
            if free < 0:
                break
            self._kept.append(self._loaded(number))

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, number: int) -> EvaluationView: ...
    @overload
    def __getitem__(self, number: slice) -> Sequence[EvaluationView]: ...
    def __getitem__(self, number: int | slice) -> EvaluationView | Sequence[EvaluationView]:
        if isinstance(number, slice):
            return [self[i] for i in range(len(self))[number]]
        number = range(len(self))[number]
        return self._kept[number] if number < len(self._kept) else self._loaded(number)

    def _loaded(self, number: int) -> EvaluationView:
        view, draw_settings = self._views[number], self._look
        found = load_evaluation_view(self._folder, view, draw_settings.camera(view.camera))
        return found.in_median_light(view.light if draw_settings.light else None).over(
            draw_settings.background
        )


def load_evaluation_views(
    folder: Path, views: Iterable[View], draw_settings: DrawSettings
) -> Sequence[EvaluationView]:
    """The views' photographs at the size of `look`, over its background and in its light; in memory
    as far as `IN_MEMORY_MIB` goes. Raises SplatError, now or when they are used."""
    return _Photographs(folder, views, draw_settings)


def load_evaluation_view(folder: Path, view: View, camera: Camera) -> EvaluationView:
    """The view's picture in `folder` on the camera's pixel grid, over black where it is cut out.
    Raises SplatError."""
    picture = load_image(folder / view.image, camera.width, camera.height)
    pixels = np.round(picture * 255).astype(np.uint8)
    mask = mask_of(folder, view, camera.width, camera.height)
    if mask is not None and view.outside == TRANSPARENT:
        pixels[mask == 0] = 0  # where JPEG left traces of an edge
    return EvaluationView(view.name, camera, pixels, mask, view.outside)


def capped_psnr_db(
    image: NDArray[np.floating],
    truth: NDArray[np.floating],
    kept: NDArray[np.bool_] | None = None,
) -> float:
    """PSNR of what a screen would show of `image`, at most `CAP_DB`; 0 for what is no number. kept
    [H, W]: the pixels that count; None for all."""
    found = psnr(np.clip(image, 0.0, 1.0), truth, kept)
    return 0.0 if np.isnan(found) else min(found, IDENTICAL_DB)


def evaluation_subset(count: int) -> range:
    """Which of `count` judges, evenly over them, where `MOST_SHOWN` must do."""
    return range(0, count, max(1, -(-count // LARGEST_SUBSET)))


def evaluate(
    draw: ImageRenderer, photographs: Sequence[EvaluationView], with_flip: bool = False
) -> list[Score]:
    """PSNR and SSIM of each, and perhaps FLIP of as many as are `spread` over them, of drawings
    clipped to what a screen can show."""
    found = []
    flipped = evaluation_subset(len(photographs)) if with_flip else ()
    for number, photograph in enumerate(photographs):
        image, truth = np.clip(draw(photograph.camera), 0.0, 1.0), photograph.image
        kept = photograph.kept
        seen = flip(image, truth, kept) if number in flipped else None
        alike = ssim(image, truth, kept)
        found.append(Score(photograph.name, capped_psnr_db(image, truth, kept), alike, seen))
    return found


def psnr_as_taken_db(
    draw: ImageRenderer, folder: Path, views: Iterable[View], draw_settings: DrawSettings
) -> tuple[float, float]:
    """Mean PSNR of photographs in the light that they were taken in: (as they are, and the right
    halves of drawings that an affine map of each channel, fitted on the left halves, adapts)."""
    plain, adapted = [], []
    for photograph in load_evaluation_views(folder, views, replace(draw_settings, light=False)):
        image, truth = np.clip(draw(photograph.camera), 0.0, 1.0), photograph.image
        half, everywhere = truth.shape[1] // 2, np.ones(truth.shape[:2], bool)
        kept = everywhere if photograph.kept is None else photograph.kept
        plain.append(capped_psnr_db(image, truth, kept))
        left, right = kept.copy(), kept.copy()
        left[:, half:], right[:, :half] = False, False
        if left.sum() > 1 and right.any():
            adapted.append(capped_psnr_db(_adapted(image, truth, left), truth, right))
    return float(np.mean(plain)), float(np.mean(adapted)) if adapted else 0.0


def _adapted(
    image: NDArray[np.floating], truth: NDArray[np.floating], where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """`image` under the affine map of each channel that brings it nearest to `truth`."""
    found = np.array(image, np.float64)
    for channel in range(3):
        known = np.stack([found[where][:, channel], np.ones(int(where.sum()))], axis=1)
        gain, offset = np.linalg.lstsq(known, truth[where][:, channel], rcond=None)[0]
        found[..., channel] = gain * found[..., channel] + offset
    return found


def psnr_inside_masks_db(
    draw: ImageRenderer, photographs: Iterable[EvaluationView]
) -> float | None:
    """Mean PSNR of what is inside the masks of cut-out photographs; None where none is."""
    found = [
        capped_psnr_db(draw(p.camera), p.image, p.mask > 0)
        for p in photographs
        if p.mask is not None and p.outside == TRANSPARENT
    ]
    return float(np.mean(found)) if found else None


def image_renderer(splats: Splats, backend: str) -> ImageRenderer:
    """What draws `splats` by their own look."""
    draw = renderer(splats, backend=backend)
    return lambda camera: draw(camera).image


def mean_psnr_db(splats: Splats, photographs: Iterable[EvaluationView], backend: str) -> float:
    """Mean PSNR over the photographs, dB."""
    draw = image_renderer(splats, backend)
    return float(np.mean([capped_psnr_db(draw(p.camera), p.image, p.kept) for p in photographs]))
