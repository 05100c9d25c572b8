"""Colours for all photographs at once: with the geometry at rest, a picture is linear in them.

Where splats sat steps out, those that stayed learnt colours for scenes that lacked the others, and
none of these scenes is ever drawn. One step of conjugate gradients over all photographs, as long as
serves it best, fits colours to the scene that is. A second one already fits noise, and so does
squaring errors that no colour explains: things that moved, edges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import SH, Rasteriser, RasterSettings, used_columns
from stages.training.optimiser import Model
from stages.training.target import forget_ignored, target_of
from stages.training.views import Level

RESTING = 1.0  # pixels that a splat must cover for its colours to be free to move by half
# Of more, what each photograph asks hardly weighs, and each costs as much as two steps.
MOST_PHOTOGRAPHS = 48
EXPLICABLE = 0.03  # an error beyond it counts by its size, not by its square (Huber 1964)


@dataclass(frozen=True)
class ColourRefit:
    """How pictures are drawn, and what they are compared with. levels: gives all photographs, each
    time that it is asked. widths [N]: of the smoothing filter, or [0]."""

    rasteriser: Rasteriser
    settings: RasterSettings
    levels: Callable[[], Iterable[Level]]
    widths: NDArray[np.float32]

    def of(self, model: Model) -> Model:
        """`model` with the colours that all photographs together ask for next."""
        pull, weight = np.zeros(model.sh.shape), np.zeros(model.sh.shape)
        for forward, error in self._errors(model):
            trust = _trust(error)
            self._add(model, forward, trust * error, pull)
            self._add(model, forward, trust, weight, of_size=True)
        stride = np.where(_own_bands(model), pull / (weight + RESTING), 0.0)
        slope = float((pull * stride).sum())
        there = replace(model, sh=(model.sh + stride).astype(np.float32))
        curve = self._change(model, there) + 2.0 * slope  # the parabola's: the rest is a line
        if not (slope > 0.0 and curve > 0.0):
            return model  # nothing to gain, or not finite
        length = slope / curve
        return replace(model, sh=(model.sh + length * stride).astype(np.float32))

    def _change(self, model: Model, there: Model) -> float:
        """By how much the errors of `there` are larger than those of `model`, squared and weighed
        by how far these are to be trusted."""
        found = 0.0
        both = zip(self._errors(model), self._errors(there), strict=True)
        for (_, error), (_, moved) in both:
            change = np.square(moved) - np.square(error)
            found += float((_trust(error) * change).sum(dtype=np.float64))
        return found

    def _errors(self, model: Model) -> Iterator[tuple[object, NDArray[np.float32]]]:
        """(forward, photograph less drawing [3, H, W]) of each photograph."""
        arrays = model.arrays
        for level in self.levels():
            forward = self.rasteriser.forward(arrays, level.camera, self.settings, self.widths)
            image = forward.image[:3]
            target = target_of(level, image, self.settings.background)
            scale = np.float32(1 / 255 if target.dtype == np.uint8 else 1)
            error = np.ascontiguousarray(target * scale - image, np.float32)
            forget_ignored(level, error)
            yield forward, error

    def _add(
        self,
        model: Model,
        forward: object,
        v_image: NDArray[np.float32],
        total: NDArray[np.float64],
        of_size: bool = False,
    ) -> None:
        """Add what `v_image` says of each coefficient to `total` [N, bands, 3], or its size."""
        backward = self.rasteriser.backward(model.arrays, forward, v_image, self.widths)
        found = backward.parameters[:, SH : used_columns(total.shape[1])]
        found = found.reshape(len(found), *total.shape[1:])
        total[backward.rows] += np.abs(found) if of_size else found


def needs_colour_refit(dropout: bool, photographs: int) -> bool:
    """Whether splats sat steps out, and so few photographs were learnt that it shows."""
    return dropout and photographs <= MOST_PHOTOGRAPHS


def _trust(error: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 for an error that colours explain, less beyond."""
    least = np.float32(EXPLICABLE)
    return np.asarray(least / np.maximum(np.abs(error), least), np.float32)


def _own_bands(model: Model) -> NDArray[np.bool_]:
    """[N, bands, 1] which bands each splat has."""
    bands = np.arange(model.sh.shape[1])
    own = bands < (model.sh_degrees[:, None].astype(int) + 1) ** 2
    return np.asarray(own[:, :, None])
