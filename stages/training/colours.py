"""Colours for all photographs at once: with the geometry at rest, a picture is linear in them.

Training ends on one photograph, then another; colours are still where the last ones pulled them,
and where splats sat steps out, they are those of a scene that is never drawn whole. One step of
conjugate gradients over all photographs, as long as serves it best, takes that out. A second one
already fits noise, and so does squaring errors that no colour explains: things that moved, edges.
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
EXPLICABLE = 0.03  # an error beyond it counts by its size, not by its square (Huber 1964)


@dataclass(frozen=True)
class Recolouring:
    """How pictures are drawn, and what they are compared with. levels: gives all photographs, each
    time that it is asked. widths [N]: of the smoothing filter, or [0]."""

    rasteriser: Rasteriser
    settings: RasterSettings
    levels: Callable[[], Iterable[Level]]
    widths: NDArray[np.float32]

    def of(self, model: Model) -> Model:
        """`model` with the colours that all photographs together ask for next."""
        pull, weight = np.zeros(model.sh.shape), np.zeros(model.sh.shape)
        before = 0.0
        for forward, error in self._errors(model):
            trust = _trust(error)
            before += _loss(error)
            self._add(model, forward, trust * error, pull)
            self._add(model, forward, trust, weight, of_size=True)
        stride = np.where(_own_bands(model), pull / (weight + RESTING), 0.0)
        there = replace(model, sh=(model.sh + stride).astype(np.float32))
        after = sum(_loss(error) for _, error in self._errors(there))
        slope = 2.0 * float((pull * stride).sum())
        bend = after - before + slope  # of the loss, taken as a parabola along the stride
        if not (slope > 0.0 and bend > 0.0):
            return model  # nothing to gain, or not finite
        length = slope / (2.0 * bend)
        return replace(model, sh=(model.sh + length * stride).astype(np.float32))

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


def _trust(error: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 for an error that colours explain, less beyond."""
    least = np.float32(EXPLICABLE)
    return np.asarray(least / np.maximum(np.abs(error), least), np.float32)


def _loss(error: NDArray[np.float32]) -> float:
    """Squared as far as it is explicable, and straight on from there."""
    size = np.abs(error)
    near = np.minimum(size, np.float32(EXPLICABLE))
    return float((near * (2 * size - near)).sum(dtype=np.float64))


def _own_bands(model: Model) -> NDArray[np.bool_]:
    """[N, bands, 1] which bands each splat has."""
    bands = np.arange(model.sh.shape[1])
    own = bands < (model.sh_degrees[:, None].astype(int) + 1) ** 2
    return np.asarray(own[:, :, None])
