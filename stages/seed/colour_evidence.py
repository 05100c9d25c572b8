"""At which depth do other photographs show the colour of a cell?

A bare wall or a blurred background has no features and no sharp detail, so neither structure from
motion nor the plane sweep finds its depth. Small pictures of a few dozen cells still show where it
may be: at the right depth, the photographs that see the place show about the same colour there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, View
from stages.scene.pictures import load_image, mask_of
from stages.seed.projection import cells, unproject, visible_points
from stages.seed.visibility import DEPTH_TOLERANCE, SUPPORT_RATIO

CELLS = 32  # along the longer side of a photograph
SOLID = 250  # of 255: least mean of the mask in a cell
SIMILAR = 0.1  # largest difference of a channel, of colours in 0..1
DIFFERENT = 0.2  # a larger one contradicts
# Depths that are tried, as factors of the first one: farther ones before nearer ones, since of
# equally good ones the first is taken, and too near is worse than too far.
FACTORS = (1.0, *(2 ** (k / 2) for k in range(1, 7)), *(2 ** (-k / 2) for k in range(1, 7)))


@dataclass(frozen=True)
class SmallPicture:
    """A photograph of CELLS cells along its longer side.

    Args:
        name: of the view.
        camera: of this size.
        colours: [h, w, 3] in 0..1.
        solid: [h, w] cells that the mask lets count.
        nearest: [h, w] depth of the nearest point in each cell, inf where there is none.
    """

    name: str
    camera: Camera
    colours: NDArray[np.float32]
    solid: NDArray[np.bool_]
    nearest: NDArray[np.float64]

    @classmethod
    def of(cls, folder: Path, view: View, points: NDArray[np.float64]) -> SmallPicture:
        """folder: that the view's paths are relative to. points: [P, 3]."""
        camera = view.camera.fitted(CELLS)
        size = camera.width, camera.height
        mask = mask_of(folder, view, *size)
        solid = np.ones(size[::-1], bool) if mask is None else mask > SOLID
        nearest = np.full(size[::-1], np.inf)
        _, pixels, depths = visible_points(camera, points)
        np.minimum.at(nearest, cells(pixels), depths)
        return cls(view.name, camera, load_image(folder / view.image, *size), solid, nearest)

    def evidence(
        self, positions: NDArray[np.float64], colours: NDArray[np.float32]
    ) -> NDArray[np.int64]:
        """[K] whether the photograph shows colours [K, 3] at positions [K, 3]: 1 if it does,
        -SUPPORT_RATIO if it shows another colour or something behind the position, 0 if it does not
        show the position or the difference is between the two."""
        found = np.zeros(len(positions), np.int64)
        rows, pixels, depths = visible_points(self.camera, positions)
        at = cells(pixels)
        ratio = depths / self.nearest[at]  # 0 where there are no points
        shown = self.solid[at] & (ratio < 1 + DEPTH_TOLERANCE)
        before = (ratio > 0) & (ratio < 1 - DEPTH_TOLERANCE)
        difference = np.abs(self._around(*at) - colours[rows]).max(-1).min(0)
        found[rows[shown & ~before & (difference < SIMILAR)]] = 1
        found[rows[shown & (before | (difference > DIFFERENT))]] = -SUPPORT_RATIO
        return found

    def _around(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
        """[9, K, 3] colours of the cells around each: positions are no finer than cells."""
        down, right = np.mgrid[-1:2, -1:2].reshape(2, 9, 1)
        height, width = self.solid.shape
        around = (rows + down).clip(0, height - 1), (columns + right).clip(0, width - 1)
        return np.asarray(self.colours[around])


def depths_by_colour(
    own: SmallPicture,
    others: Sequence[SmallPicture],
    at: NDArray[np.float64],
    near: NDArray[np.float64],
    first: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[K] depths at which other photographs contradict cells least: the first one of each where
    at most one in SUPPORT_RATIO + 1 of the photographs that tell contradicts it.

    Args:
        own: the photograph.
        others: all others.
        at: [K, 2] centres of cells, in pixels of `own`.
        near: [K] the least depth of each.
        first: [K] the depth that is tried first.
    """
    colours = own.colours[cells(at)]
    depths = np.array([np.maximum(near, factor * first) for factor in FACTORS])
    scores = np.zeros(depths.shape, np.int64)
    for score, depth in zip(scores, depths, strict=True):
        positions = unproject(own.camera, at, depth)
        for other in others:
            score += other.evidence(positions, colours)
    best = np.where(scores[0] >= 0, 0, scores.argmax(0))
    return np.asarray(depths[best, np.arange(len(at))])
