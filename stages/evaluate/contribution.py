"""The contribution of each splat, and of each SH degree of its colour, to a set of views.

The rasteriser sums, for every splat and view, what the picture and its squared error would change
by if that splat alone were removed (see `raster.definition`). Here these sums are added over views.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.evaluation import EvaluationView, image_renderer
from stages.evaluate.image_metrics import capped_psnr_db
from stages.raster.backends import rasteriser_of
from stages.raster.definition import (
    ERROR_CHANGE,
    LARGEST_WEIGHT,
    PICTURE_CHANGE,
    SQUARED_WEIGHT,
    WEIGHT,
    WEIGHTED_RESIDUAL,
    Forward,
    Rasteriser,
    splat_arrays,
)
from stages.raster.draw import raster_settings_of
from stages.raster.sh import sh_basis
from stages.scene import IGNORE, Camera, Splats

VISIBLE_WEIGHT = 1.0 / 255.0  # a smaller blend weight cannot change an 8-bit picture
MAX_MEASURED_VIEWS = 48  # in a round of removal; enough to say which splats contribute least
MARGIN = 0.25  # of the longer side: as far as seeding continues a picture beyond its edge


@dataclass(frozen=True)
class Contributions:
    """What N splats contribute to V views.

    Squared errors are sums over pixels and channels. L is the SH degree of the splats.

    Args:
        sse_change: [N] change of the summed squared error if this splat alone were removed;
            negative where the views would be matched better without it.
        picture_change: [N] summed squared change of the pictures by the same removal.
        weight: [N] summed blend weight.
        kept_weight: [N] summed blend weight over the pixels that no mask ignores.
        view_counts: [N] views in which a pixel has a blend weight of 1/255 or more.
        sse: summed squared error of the pictures as they are.
        scene_depth: [V] median depth of each picture, world units; inf where nothing is drawn.
        truncated_sse_change: [N, L] as `sse_change`, if the colour kept only the SH coefficients up
            to degree 0..L - 1 and the mean of what is lost were added to its DC.
        truncated_picture_change: [N, L] as `picture_change`, for the same truncation.
        truncated_colour: [N, L, 3] the mean that is added to the colour.
        psnr_db: [V] PSNR of each picture.
        sh_sums: the sums that the truncated figures come from, so that more views can be added.
        previous: the contributions that this measurement started from. They are included in all
            fields but `psnr_db`.
    """

    sse_change: NDArray[np.float64]
    picture_change: NDArray[np.float64]
    weight: NDArray[np.float64]
    kept_weight: NDArray[np.float64]
    view_counts: NDArray[np.int32]
    sse: float
    scene_depth: NDArray[np.float64]
    truncated_sse_change: NDArray[np.float64]
    truncated_picture_change: NDArray[np.float64]
    truncated_colour: NDArray[np.float64]
    psnr_db: NDArray[np.float64]
    sh_sums: tuple[NDArray[np.float64], ...] = ()
    previous: Contributions | None = None

    def take(self, rows: NDArray[np.bool_]) -> Contributions:
        """The contributions of these splats only."""
        return replace(
            self,
            sse_change=self.sse_change[rows],
            picture_change=self.picture_change[rows],
            weight=self.weight[rows],
            kept_weight=self.kept_weight[rows],
            view_counts=self.view_counts[rows],
            truncated_sse_change=self.truncated_sse_change[rows],
            truncated_picture_change=self.truncated_picture_change[rows],
            truncated_colour=self.truncated_colour[rows],
            previous=self.previous and self.previous.take(rows),
            sh_sums=tuple(sums[rows] for sums in self.sh_sums),
        )


def measure_contributions(
    splats: Splats,
    views: Iterable[EvaluationView],
    backend: str,
    previous: Contributions | None = None,
    truncation: bool = True,
    beyond: float = 0.0,
) -> Contributions:
    """The contribution of each splat to the views.

    Args:
        splats: drawn by their own settings.
        views: to compare with.
        backend: the rasteriser's name.
        previous: contributions of the same splats to further views. They may have been measured
            before the splats around them changed a little. The result includes them.
        truncation: whether to measure the truncated figures; else these are [N, 0].
        beyond: how far each picture is continued on all sides, in longer sides of the picture. What
            is drawn there counts as if it were right; `sse` and `psnr_db` are of the picture alone.
    """
    rasteriser = rasteriser_of(backend)
    arrays = rasteriser.loaded(splat_arrays(splats))
    settings, sums = raster_settings_of(splats), _Sums(len(splats), previous)
    sh = _ShTruncation(splats, truncation, previous.sh_sums if previous else ())
    for view in views:
        border = round(beyond * max(view.camera.width, view.camera.height))
        forward = rasteriser.forward(arrays, view.camera.continued(border), settings, depths=True)
        residual = sums.add_picture(forward, view, border)
        found = rasteriser.contributions(forward, residual)
        kept_weight = _kept_weight(rasteriser, forward, view, border, found)
        sums.add_splats(forward.visible, found, kept_weight)
        sh.add(view.camera.centre, forward.visible, found)
    truncated_sse_change, truncated_picture_change, truncated_colour = sh.figures()
    return Contributions(
        sse_change=sums.change,
        picture_change=sums.picture,
        weight=sums.weight,
        kept_weight=sums.kept_weight,
        view_counts=sums.view_counts,
        sse=sums.sse,
        scene_depth=np.array(sums.depths),
        truncated_sse_change=truncated_sse_change,
        truncated_picture_change=truncated_picture_change,
        truncated_colour=truncated_colour,
        psnr_db=np.array(sums.psnr_db),
        sh_sums=sh.sums,
        previous=previous,
    )


class _Sums:
    """The fields of `Contributions` that are sums or lists over views."""

    def __init__(self, n: int, previous: Contributions | None) -> None:
        self.change, self.picture, self.weight, self.kept_weight = np.zeros((4, n))
        self.view_counts, self.sse = np.zeros(n, np.int32), 0.0
        self.depths: list[float] = []
        self.psnr_db: list[float] = []
        if previous is not None:
            self.change, self.picture = previous.sse_change.copy(), previous.picture_change.copy()
            self.weight, self.kept_weight = previous.weight.copy(), previous.kept_weight.copy()
            self.view_counts, self.sse = previous.view_counts.copy(), previous.sse
            self.depths = previous.scene_depth.tolist()

    def add_picture(
        self, forward: Forward, view: EvaluationView, border: int
    ) -> NDArray[np.float32]:
        """Add what a picture, continued by `border` pixels, says as a whole; its residual
        [3, H, W], 0 outside the view."""
        drawn = _inside(forward.image[:3], border).transpose(1, 2, 0)
        self.psnr_db.append(capped_psnr_db(drawn, view.image, view.valid))
        residual = np.zeros_like(forward.image[:3])
        _inside(residual, border)[:] = (drawn - view.image).transpose(2, 0, 1)
        if view.valid is not None:
            _inside(residual, border)[:] *= view.valid
        self.sse += float(np.sum(residual.astype(np.float64) ** 2))
        solid = forward.image[4][forward.image[3] > 0.5]
        self.depths.append(float(np.median(solid)) if solid.size else np.inf)
        return residual

    def add_splats(
        self,
        rows: NDArray[np.int32],
        found: NDArray[np.float64],
        kept_weight: NDArray[np.float64],
    ) -> None:
        """Add the rasteriser's contributions `found` [K, ...] of the splats `rows` [K]."""
        self.change[rows] += found[:, ERROR_CHANGE]
        self.picture[rows] += found[:, PICTURE_CHANGE]
        self.weight[rows] += found[:, WEIGHT]
        self.kept_weight[rows] += kept_weight
        self.view_counts[rows] += found[:, LARGEST_WEIGHT] >= VISIBLE_WEIGHT


def _inside(image: NDArray[np.float32], border: int) -> NDArray[np.float32]:
    """A view of `image` [C, H, W] without its border."""
    _, height, width = image.shape
    return image[:, border : height - border, border : width - border]


def _kept_weight(
    rasteriser: Rasteriser,
    forward: Forward,
    view: EvaluationView,
    border: int,
    found: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[K] summed blend weight over the pixels that the view's mask does not ignore. border: how
    many pixels the picture is continued by. found: [K, ...] the rasteriser's contributions."""
    if view.mask is None or view.outside != IGNORE:
        return found[:, WEIGHT]
    kept = np.pad((view.mask > 0).astype(np.float32), border, constant_values=1.0)
    kept = np.repeat(kept[None], 3, axis=0)
    return rasteriser.contributions(forward, kept)[:, WEIGHTED_RESIDUAL]


class _ShTruncation:
    """Sums over views for each SH degree that colours may be truncated to.

    d is the change of a splat's colour in a view, g the gradient of half the squared error with
    respect to that colour, q the splat's summed squared blend weights.
    """

    def __init__(
        self, splats: Splats, wanted: bool, start: tuple[NDArray[np.float64], ...]
    ) -> None:
        self.splats, self.degrees = splats, splats.sh_degree if wanted else 0
        shape = (len(splats), self.degrees, 3)
        if start:
            self.sums = tuple(sums.copy() for sums in start)
        else:
            shapes = (shape, shape, shape, (len(splats), 1, 3), (len(splats), 1, 1))
            self.sums = tuple(np.zeros(one) for one in shapes)
        self.dg, self.ddq, self.dq, self.g, self.q = self.sums

    def add(
        self, centre: NDArray[np.floating], rows: NDArray[np.int32], found: NDArray[np.float64]
    ) -> None:
        """Add one view: its camera centre [3] and the rasteriser's contributions [K, ...] of the
        splats `rows` [K]."""
        if not self.degrees:
            return
        every = colours_by_degree(self.splats.take(rows), centre)
        d = every[:, :-1] - every[:, -1:]
        g, q = found[:, None, WEIGHTED_RESIDUAL:], found[:, SQUARED_WEIGHT, None, None]
        self.dg[rows] += d * g
        self.ddq[rows] += d * d * q
        self.dq[rows] += d * q
        self.g[rows] += g
        self.q[rows] += q

    def figures(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The truncated figures of `Contributions`.

        With s added to the colour, the squared error of each view changes by
        2 (d + s) g + (d + s)^2 q. The s that is used makes the mean of d + s, weighted by q, zero.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            s = np.where(self.q > 0, -self.dq / self.q, 0.0)
        by_residual = 2 * (self.dg + s * self.g)
        of_picture = self.ddq + 2 * s * self.dq + s * s * self.q
        return (by_residual + of_picture).sum(2), of_picture.sum(2), s


def blend_weights(
    splats: Splats, cameras: Iterable[Camera], backend: str
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.float64]]]:
    """For each camera: the rows [K] of the splats that it shows, and the sum of each one's blend
    weights over the picture [K], pixels."""
    rasteriser = rasteriser_of(backend)
    arrays = rasteriser.loaded(splat_arrays(splats))
    settings = raster_settings_of(splats)
    for camera in cameras:
        forward = rasteriser.forward(arrays, camera, settings)
        no_residual = np.zeros((3, camera.height, camera.width), np.float32)
        yield forward.visible, rasteriser.contributions(forward, no_residual)[:, WEIGHT]


def colours_by_degree(splats: Splats, centre: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N, L + 1, 3] colour of each splat seen from `centre` [3], with the SH coefficients up to
    degree 0..L."""
    offsets = splats.means - centre
    with np.errstate(invalid="ignore", divide="ignore"):
        directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    basis = sh_basis(directions, splats.sh_degree)
    terms = basis[:, :, None] * splats.sh
    ends = np.arange(1, splats.sh_degree + 2) ** 2 - 1
    return np.maximum(0.5 + np.cumsum(terms, axis=1)[:, ends], 0.0)


def squared_error(splats: Splats, views: Iterable[EvaluationView], backend: str) -> float:
    """The squared error of the pictures, summed over pixels and channels of all views."""
    draw, found = image_renderer(splats, backend), 0.0
    for view in views:
        squares = np.square(draw(view.camera) - view.image, dtype=np.float64)
        found += float(squares.sum() if view.valid is None else squares[view.valid].sum())
    return found


def near_view_frusta(
    splats: Splats, cameras: Iterable[Camera], margin: float = MARGIN
) -> NDArray[np.bool_]:
    """[N] splats that project into a picture or beyond its edge by at most `margin` of its longer
    side, where new views look."""
    near = np.zeros(len(splats), bool)
    for camera in cameras:
        pixels, z = camera.project(splats.means)
        size = np.array([camera.width, camera.height])
        beyond = margin * size.max()
        near |= (z > 0) & ((pixels > -beyond) & (pixels < size + beyond)).all(1)
    return near
