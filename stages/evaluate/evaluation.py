"""The one evaluation: views with their photographs, and how near drawings of splats are to them.

Every figure of quality in a run comes from here: the same photographs in 8 bits, at the size that
the splats were trained at, drawn by the run's backend with the near plane of the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import overload

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.evaluate.image_metrics import capped_psnr_db, flip, has_flip, ssim
from stages.raster.draw import renderer
from stages.scene import IGNORE, TRANSPARENT, Camera, DrawSettings, Splats, View
from stages.scene.light import BRIGHT, Light, gains_and_offsets
from stages.scene.pictures import load_image, mask_of, scaled_image, scaled_mask

IN_MEMORY_MIB = 512  # of photographs; further ones are read from disk each time
LARGEST_SUBSET = 24  # held-out views for what is too slow, or takes too much room, for all
SIZES = {"full": 1.0, "half": 0.5, "quarter": 0.25}  # of the pictures, by name; each side's scale
ImageRenderer = Callable[[Camera], NDArray[np.floating]]  # a picture [H, W, 3]


@dataclass(frozen=True)
class EvaluationView:
    """A view with its photograph, at the size of the comparison.

    Args:
        name: of the photograph.
        camera: at this size.
        pixels: [H, W, 3] uint8, sRGB.
        mask: [H, W], as in `scene.Photo`; None where all pixels count.
        outside: what is outside the mask, as in `scene.Photo`.
        excluded: [H, W] further pixels that are not compared, as those with a channel too bright
            to be measured; None where there are none.
    """

    name: str
    camera: Camera
    pixels: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None = None
    outside: str = ""
    excluded: NDArray[np.bool_] | None = None

    @property
    def image(self) -> NDArray[np.float32]:
        """[H, W, 3] in [0, 1]."""
        return self.pixels * np.float32(1 / 255)

    @property
    def valid(self) -> NDArray[np.bool_] | None:
        """[H, W] the pixels that are compared, or None for all."""
        valid = self.mask > 0 if self.mask is not None and self.outside == IGNORE else None
        if self.excluded is None:
            return valid
        return ~self.excluded if valid is None else valid & ~self.excluded

    @property
    def counts(self) -> bool:
        """Whether any pixel is compared."""
        return self.valid is None or bool(self.valid.any())

    def in_median_light(self, light: Light | None) -> EvaluationView:
        """With the exposure and white balance of the median photograph; see `scene.light`."""
        if light is None:
            return self
        gains, offsets = gains_and_offsets(light)
        alpha = self.mask if self.outside == TRANSPARENT else None
        solid = np.float32(1) if alpha is None else alpha[..., None] * np.float32(1 / 255)
        even = (self.image - offsets * solid) / gains
        pixels = np.rint(even * 255).clip(0, 255).astype(np.uint8)
        return replace(self, pixels=pixels, excluded=np.asarray((self.image >= BRIGHT).any(2)))

    def compared_within(self, valid: NDArray[np.bool_] | None) -> EvaluationView:
        """The same, where only pixels of `valid` [h, w] are compared; None: all. At another size a
        pixel is compared if all pixels of `valid` under it are true."""
        if valid is None:
            return self
        height, width = self.pixels.shape[:2]
        outside = np.asarray(scaled_image((~valid).astype(np.float32), width, height) > 0)
        return replace(self, excluded=outside if self.excluded is None else self.excluded | outside)

    def compared_where_solid(self) -> EvaluationView:
        """The same, where no pixel is compared that is transparent, wholly or in part."""
        if self.mask is None or self.outside != TRANSPARENT:
            return self
        return self.compared_within(self.mask == 255)

    def black_where_not_compared(self) -> EvaluationView:
        """The same, black where no pixel is compared: windows of SSIM reach over such pixels."""
        if (valid := self.valid) is None:
            return self
        return replace(self, pixels=np.where(valid[..., None], self.pixels, np.uint8(0)))

    def scaled(self, scale: float) -> EvaluationView:
        """At `scale` (at most 1) times the size along each side, by area averaging as in
        `scene.pictures`. A pixel is compared if all pixels that it averages are."""
        if scale == 1:
            return self
        camera = self.camera.resized(
            *(max(1, round(scale * side)) for side in (self.camera.width, self.camera.height))
        )
        size = camera.width, camera.height
        mask, excluded = self.mask, self.excluded
        if mask is not None:
            mask = scaled_mask(mask, *size, self.outside)
        if excluded is not None:
            excluded = scaled_image(excluded.astype(np.float32), *size) > 0
        pixels = np.rint(scaled_image(self.image, *size) * 255).astype(np.uint8)
        return replace(self, camera=camera, pixels=pixels, mask=mask, excluded=excluded)

    def over(self, grey: float) -> EvaluationView:
        """Composited over `grey` (0 to 1) instead of black, where it has transparency."""
        if self.mask is None or self.outside != TRANSPARENT:
            return self
        behind = (255 - self.mask[..., None]) * np.float32(grey)
        return replace(self, pixels=np.rint(self.pixels + behind).clip(0, 255).astype(np.uint8))


@dataclass(frozen=True)
class Score:
    """How near one drawing is to its photograph, by the definitions in `image_metrics`. psnr_db: at
    most `IDENTICAL_DB`. flip: None where it was not computed. inside_db: PSNR inside the mask of a
    transparent photograph. PSNR and SSIM are NaN where no pixel is compared: see `counts`."""

    name: str
    psnr_db: float
    ssim: float
    flip: float | None = None
    inside_db: float | None = None

    @property
    def counts(self) -> bool:
        """Whether any pixel was compared. Means are of such scores alone."""
        return not np.isnan(self.psnr_db)


class _EvaluationViews(Sequence[EvaluationView]):
    """The first views in memory, the others on disk."""

    def __init__(
        self, folder: Path, views: Iterable[View], draw_settings: DrawSettings, stop: Event | None
    ) -> None:
        self._folder, self._views, self._draw_settings = folder, tuple(views), draw_settings
        self._stop = stop
        self._loaded: list[EvaluationView] = []
        free = IN_MEMORY_MIB * 2**20
        for number, view in enumerate(self._views):
            camera = draw_settings.camera(view.camera)
            free -= 4 * camera.width * camera.height  # three colours and perhaps a mask
            if free < 0:
                break
            self._loaded.append(self._load(number))

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
        self._stop_if_requested()
        return self._loaded[number] if number < len(self._loaded) else self._load(number)

    def _stop_if_requested(self) -> None:
        if self._stop is not None and self._stop.is_set():
            raise Interrupted("stopped before a view")

    def _load(self, number: int) -> EvaluationView:
        self._stop_if_requested()
        view, draw_settings = self._views[number], self._draw_settings
        camera = draw_settings.camera(view.camera)
        found = load_evaluation_view(self._folder, view, camera)
        return found.in_median_light(view.light if draw_settings.light else None).over(
            draw_settings.background
        )


def load_evaluation_views(
    folder: Path, views: Iterable[View], draw_settings: DrawSettings, stop: Event | None = None
) -> Sequence[EvaluationView]:
    """The views with their photographs, at the size, background and light of `draw_settings`.

    As many as fit into `IN_MEMORY_MIB` are read at once. Raises SplatError, now or when a view is
    used, and Interrupted when `stop` is set.
    """
    return _EvaluationViews(folder, views, draw_settings, stop)


def load_evaluation_view(folder: Path, view: View, camera: Camera) -> EvaluationView:
    """The view's picture in `folder` on the camera's pixel grid, over black where it is
    transparent. Raises SplatError."""
    picture = load_image(folder / view.image, camera.width, camera.height)
    mask = mask_of(folder, view, camera.width, camera.height)
    pixels = np.round(picture * 255).astype(np.uint8)
    if mask is not None and view.outside == TRANSPARENT:
        pixels[mask == 0] = 0  # where JPEG left traces of an edge
    return EvaluationView(view.name, camera, pixels, mask, view.outside)


def evaluation_subset(count: int, most: int = LARGEST_SUBSET) -> range:
    """Indices of at most `most` of `count` views, evenly spaced."""
    return range(0, count, max(1, -(-count // most)))


def evaluate(
    draw: ImageRenderer, views: Sequence[EvaluationView], with_flip: bool = False
) -> list[Score]:
    """Compare drawings, clipped to [0, 1], with the views' photographs.

    Args:
        draw: draws a camera's picture.
        views: to compare with.
        with_flip: also compute FLIP, which takes five times as long as PSNR and SSIM, for the
            `evaluation_subset` of the views.
    """
    return evaluate_at_sizes(draw, views, {"full": 1.0}, with_flip)["full"]


def evaluate_at_sizes(
    draw: ImageRenderer,
    views: Sequence[EvaluationView],
    sizes: Mapping[str, float] = SIZES,
    with_flip: bool = False,
) -> dict[str, list[Score]]:
    """`evaluate` the views at several sizes: a viewer does not draw at the size of training.

    Args:
        draw: draws a camera's picture, at the camera's size.
        views: at the full size; smaller photographs are area averages, see `EvaluationView.scaled`.
        sizes: the scale of each side, at most 1, by name.
        with_flip: as in `evaluate`, of the full size.

    Returns:
        The scores of all views, in their order, by the name of the size.
    """
    scores: dict[str, list[Score]] = {name: [] for name in sizes}
    with_flip_too = evaluation_subset(len(views)) if with_flip and has_flip() else ()
    for number, full in enumerate(views):
        for name, scale in sizes.items():
            view = full.scaled(scale)
            if not view.counts:
                scores[name].append(Score(view.name, np.nan, np.nan))
                continue
            image, truth = np.clip(draw(view.camera), 0.0, 1.0), view.image
            valid = view.valid
            flips = scale == 1 and number in with_flip_too
            error = flip(image, truth, valid) if flips else None
            psnr_db, similarity = capped_psnr_db(image, truth, valid), ssim(image, truth, valid)
            inside_db = None
            if view.mask is not None and view.outside == TRANSPARENT:
                inside_db = capped_psnr_db(image, truth, view.mask > 0)
            scores[name].append(Score(view.name, psnr_db, similarity, error, inside_db))
    return scores


def psnr_as_taken_db(
    draw: ImageRenderer, folder: Path, views: Iterable[View], draw_settings: DrawSettings
) -> tuple[float, float]:
    """Mean PSNR against photographs in the light that they were taken in, in two ways.

    Returns:
        The mean PSNR of the drawings as they are, and that of their right halves after an affine
        map of each channel that was fitted to the left halves.
    """
    unadapted, adapted = [], []
    as_taken = replace(draw_settings, light=False)
    for view in load_evaluation_views(folder, views, as_taken):
        if not view.counts:
            continue
        image, truth = np.clip(draw(view.camera), 0.0, 1.0), view.image
        half, everywhere = truth.shape[1] // 2, np.ones(truth.shape[:2], bool)
        valid = everywhere if view.valid is None else view.valid
        unadapted.append(capped_psnr_db(image, truth, valid))
        left, right = valid.copy(), valid.copy()
        left[:, half:], right[:, :half] = False, False
        if left.sum() > 1 and right.any():
            adapted.append(capped_psnr_db(_affinely_mapped(image, truth, left), truth, right))
    return float(np.mean(unadapted)), float(np.mean(adapted)) if adapted else 0.0


def _affinely_mapped(
    image: NDArray[np.floating], truth: NDArray[np.floating], where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """`image` under the affine map of each channel that brings it nearest to `truth` at `where`."""
    found = np.array(image, np.float64)
    for channel in range(3):
        known = np.stack([found[where][:, channel], np.ones(int(where.sum()))], axis=1)
        gain, offset = np.linalg.lstsq(known, truth[where][:, channel], rcond=None)[0]
        found[..., channel] = gain * found[..., channel] + offset
    return found


def image_renderer(splats: Splats, backend: str) -> ImageRenderer:
    """A function that draws `splats`, by their own settings, for a camera."""
    draw = renderer(splats, backend=backend)
    return lambda camera: draw(camera).image


def psnr_of_views_db(
    splats: Splats, views: Iterable[EvaluationView], backend: str
) -> NDArray[np.float64]:
    """[V] PSNR of each view, dB; NaN where no pixel is compared."""
    draw = image_renderer(splats, backend)
    return np.array(
        [capped_psnr_db(draw(v.camera), v.image, v.valid) if v.counts else np.nan for v in views]
    )


def mean_psnr_db(
    splats: Splats, views: Iterable[EvaluationView], backend: str, scale: float = 1.0
) -> float:
    """Mean PSNR over the views that have a compared pixel, each `EvaluationView.scaled`, dB; 0
    without such a view."""
    scaled = (view.scaled(scale) for view in views)
    found = psnr_of_views_db(splats, scaled, backend)
    found = found[~np.isnan(found)]
    return float(found.mean()) if found.size else 0.0


def psnr_name(size: str, stem: str = "psnr") -> str:
    """The name of a metric at one of `SIZES`: psnr_db, psnr_half_db, psnr_quarter_db."""
    return f"{stem}_db" if size == "full" else f"{stem}_{size}_db"
