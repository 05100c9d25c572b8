"""What each splat and each band of its colour is worth to photographs; which are floaters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.measure.evaluation import EvaluationView, capped_psnr_db, image_renderer
from stages.raster.backends import rasteriser_of
from stages.raster.definition import (
    ERROR_CHANGE,
    LARGEST_WEIGHT,
    SQUARED_WEIGHT,
    WEIGHT,
    WEIGHTED_RESIDUAL,
    splat_arrays,
)
from stages.raster.draw import raster_settings_of
from stages.raster.reference import sh_basis
from stages.scene import Camera, Splats

SEEN = 1.0 / 255.0  # a weight below it cannot change an 8-bit picture
NEAR_CAMERA = 0.25  # of the depth at which that camera sees the scene
FEW_PHOTOGRAPHS = 2
RIM = 0.25  # of the longer side: as far as seeds continue a photograph beyond its rim


@dataclass(frozen=True)
class Contributions:
    """Per splat [N]. sse_change: of the summed squared error over all photographs if it alone
    were removed (negative: they would be better without it). picture_change: the summed squared
    change of the pictures then, whatever the photographs say to it. weight: summed blend weight;
    largest_weight: in any pixel. photographs: in how many it has a weight of 1/255 somewhere.
    sse: summed squared error now. scene_depth, psnr_db [photographs]: median depth of each picture,
    and how near it is.

    truncated_sse_change, truncated_picture_change [N, L]: the same two if its colour kept only
    the bands up to degree
    0..L - 1, the mean of what is lost baked in: truncated_colour [N, L, 3],
    what that adds to its colour.
    bands: the sums that this was told from. others: what it went on from, included in all but
    psnr_db.
    """

    sse_change: NDArray[np.float64]
    picture_change: NDArray[np.float64]
    weight: NDArray[np.float64]
    largest_weight: NDArray[np.float64]
    photographs: NDArray[np.int32]
    sse: float
    scene_depth: NDArray[np.float64]
    truncated_sse_change: NDArray[np.float64]
    truncated_picture_change: NDArray[np.float64]
    truncated_colour: NDArray[np.float64]
    psnr_db: NDArray[np.float64]
    bands: tuple[NDArray[np.float64], ...] = ()
    others: Contributions | None = None

    def take(self, rows: NDArray[np.bool_]) -> Contributions:
        """Of these splats alone; their bands are no longer told."""
        return replace(
            self,
            sse_change=self.sse_change[rows],
            picture_change=self.picture_change[rows],
            weight=self.weight[rows],
            largest_weight=self.largest_weight[rows],
            photographs=self.photographs[rows],
            bands=tuple(sums[rows] for sums in self.bands),
        )


def measure_contributions(
    splats: Splats,
    photographs: Iterable[EvaluationView],
    backend: str,
    others: Contributions | None = None,
) -> Contributions:
    """What each splat does for the photographs, drawn by its own look. others: what it did for
    further ones, before it or what is around it changed a little; that goes on counting."""
    n = len(splats)
    change, picture = np.zeros(n), np.zeros(n)
    weight, largest = np.zeros(n), np.zeros(n)
    seen_in, sse, depths, psnr_db = np.zeros(n, np.int32), 0.0, [], []
    if others is not None:
        change, picture = others.sse_change.copy(), others.picture_change.copy()
        weight, largest = others.weight.copy(), others.largest_weight.copy()
        seen_in, sse = others.photographs.copy(), others.sse
        depths = others.scene_depth.tolist()
    rasteriser, arrays = rasteriser_of(backend), splat_arrays(splats)
    settings, bands = raster_settings_of(splats), _Bands(splats, others.bands if others else ())
    for photograph in photographs:
        forward = rasteriser.forward(arrays, photograph.camera, settings, depths=True)
        drawn, truth = forward.image[:3].transpose(1, 2, 0), photograph.image
        psnr_db.append(capped_psnr_db(drawn, truth, photograph.kept))
        residual = np.ascontiguousarray((drawn - truth).transpose(2, 0, 1))
        if photograph.kept is not None:
            residual *= photograph.kept
        sse += float(np.sum(residual.astype(np.float64) ** 2))
        solid = forward.image[4][forward.image[3] > 0.5]
        depths.append(float(np.median(solid)) if solid.size else np.inf)
        alone = rasteriser.contributions(forward, np.zeros_like(residual))[:, ERROR_CHANGE]
        found = rasteriser.contributions(forward, residual)
        rows = forward.visible
        change[rows] += found[:, ERROR_CHANGE]
        picture[rows] += alone
        weight[rows] += found[:, WEIGHT]
        largest[rows] = np.maximum(largest[rows], found[:, LARGEST_WEIGHT])
        seen_in[rows] += found[:, LARGEST_WEIGHT] >= SEEN
        bands.add(photograph.camera.centre, rows, found)
    truncated_sse_change, truncated_picture_change, truncated_colour = bands.cuts()
    return Contributions(
        change,
        picture,
        weight,
        largest,
        seen_in,
        sse,
        np.array(depths),
        truncated_sse_change,
        truncated_picture_change,
        truncated_colour,
        np.array(psnr_db),
        bands.sums,
        others,
    )


class _Bands:
    """Sums over photographs for each degree that colours may be cut to: d the change of a splat's
    colour there, g the pull of the residual on it, q its squared weights."""

    def __init__(self, splats: Splats, start: tuple[NDArray[np.float64], ...]) -> None:
        shape = (len(splats), splats.sh_degree, 3)
        self.splats = splats
        if start:
            self.sums = tuple(sums.copy() for sums in start)
        else:
            shapes = (shape, shape, shape, (len(splats), 1, 3), (len(splats), 1, 1))
            self.sums = tuple(np.zeros(one) for one in shapes)
        self.linear, self.square, self.shift, self.pull, self.squares = self.sums

    def add(
        self, centre: NDArray[np.floating], rows: NDArray[np.int32], found: NDArray[np.float64]
    ) -> None:
        """One photograph. found [V, CONTRIBUTIONS] of the splats `rows`."""
        if not self.splats.sh_degree:
            return
        every = colours_by_degree(self.splats.take(rows), centre)
        d = every[:, :-1] - every[:, -1:]
        g, q = found[:, None, WEIGHTED_RESIDUAL:], found[:, SQUARED_WEIGHT, None, None]
        self.linear[rows] += d * g
        self.square[rows] += d * d * q
        self.shift[rows] += d * q
        self.pull[rows] += g
        self.squares[rows] += q

    def cuts(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(truncated_sse_change, truncated_picture_change, truncated_colour) of `Worth`: with s
        added to the
        colour, each
        photograph's error changes by 2 (d + s) g + (d + s)^2 q; s is what makes the mean of d,
        weighted by q, zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            s = np.where(self.squares > 0, -self.shift / self.squares, 0.0)
        by_residual = 2 * (self.linear + s * self.pull)
        of_picture = self.square + 2 * s * self.shift + s * s * self.squares
        return (by_residual + of_picture).sum(2), of_picture.sum(2), s


def colours_by_degree(splats: Splats, centre: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N, L + 1, 3] colour of each splat seen from `centre`, with the bands up to degree 0..L."""
    offsets = splats.means - centre
    with np.errstate(invalid="ignore", divide="ignore"):
        directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    basis = sh_basis(torch.from_numpy(directions), splats.sh_degree).numpy()
    terms = basis[:, :, None] * splats.sh
    ends = np.arange(1, splats.sh_degree + 2) ** 2 - 1
    return np.maximum(0.5 + np.cumsum(terms, axis=1)[:, ends], 0.0)


def squared_error(splats: Splats, photographs: Iterable[EvaluationView], backend: str) -> float:
    """Summed over all photographs, as `Worth.sse`."""
    draw, found = image_renderer(splats, backend), 0.0
    for photograph in photographs:
        squares = np.square(draw(photograph.camera) - photograph.image, dtype=np.float64)
        found += float(squares.sum() if photograph.kept is None else squares[photograph.kept].sum())
    return found


def floaters(splats: Splats, worth: Contributions, cameras: list[Camera]) -> NDArray[np.bool_]:
    """[N] splats that hang in empty space: close before a camera, compared with what that camera
    sees behind, and needed by at most two photographs."""
    close = np.zeros(len(splats), bool)
    for camera, depth in zip(cameras, worth.scene_depth, strict=True):
        if np.isfinite(depth):
            distance = np.linalg.norm(splats.means - camera.centre, axis=1)
            close |= distance < NEAR_CAMERA * depth
    return np.asarray(close & (worth.photographs <= FEW_PHOTOGRAPHS))


def near_view_frusta(splats: Splats, cameras: list[Camera]) -> NDArray[np.bool_]:
    """[N] splats in a picture or just beyond its rim, where the next view will look."""
    beside = np.zeros(len(splats), bool)
    for camera in cameras:
        pixels, z = camera.project(splats.means)
        size = np.array([camera.width, camera.height])
        margin = RIM * size.max()
        beside |= (z > 0) & ((pixels > -margin) & (pixels < size + margin)).all(1)
    return beside
