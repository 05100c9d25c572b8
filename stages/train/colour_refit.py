"""Refits the SH coefficients to all training views at once after training with dropout.

With dropout, colours are trained for pictures that lack the dropped splats, and no such picture is
ever drawn. With fixed geometry, a picture is linear in the SH coefficients, so one step of
conjugate gradients over all training views, with an optimal step length, fits them to the complete
model. A second step would fit noise. Squared errors would fit outliers (things that moved, edges),
so errors are weighted as by Huber (1964).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import SH, Rasteriser, RasterSettings, used_columns
from stages.raster.sh import own_coefficients
from stages.train.optimiser import Model
from stages.train.views import Level, ignore_masked, target_of

DAMPING = 1.0  # pixels; a splat that covers so many takes half of its step
# With more views each adds little, and each costs as much as two training steps.
MAX_REFIT_VIEWS = 48
HUBER_THRESHOLD = 0.03  # colour values: a larger error counts linearly, not squared


@dataclass(frozen=True)
class ColourRefit:
    """A refit of colours.

    Args:
        rasteriser: renders the pictures.
        settings: to render them with.
        levels: gives all training views each time it is called.
        smooth: whether to render with the model's smoothing widths.
    """

    rasteriser: Rasteriser
    settings: RasterSettings
    levels: Callable[[], Iterable[Level]]
    smooth: bool = False

    def of(self, model: Model) -> Model:
        """`model` with refitted colours; `model` itself if they cannot be improved."""
        gradient, weight = np.zeros(model.sh.shape), np.zeros(model.sh.shape)
        for forward, error in self._errors(model):
            huber = _huber_weights(error)
            self._add(forward, huber * error, gradient)
            self._add(forward, huber, weight, absolute=True)
        own = own_coefficients(model.sh_degrees, model.sh.shape[1])
        direction = np.where(own, gradient / (weight + DAMPING), 0.0)
        slope = float((gradient * direction).sum())
        moved = replace(model, sh=(model.sh + direction).astype(np.float32))
        curvature = self._change(model, moved) + 2.0 * slope  # of the error along the direction
        if not (slope > 0.0 and curvature > 0.0):
            return model  # no improvement, or not finite
        length = slope / curvature
        return replace(model, sh=(model.sh + length * direction).astype(np.float32))

    def _change(self, model: Model, moved: Model) -> float:
        """By how much the weighted squared errors of `moved` exceed those of `model`."""
        change = 0.0
        both = zip(self._errors(model), self._errors(moved), strict=True)
        for (_, before), (_, after) in both:
            difference = np.square(after, dtype=np.float64) - np.square(before, dtype=np.float64)
            change += float((_huber_weights(before) * difference).sum(dtype=np.float64))
        return change

    def _errors(self, model: Model) -> Iterator[tuple[object, NDArray[np.float32]]]:
        """(result of the forward pass, target less render [3, H, W]) of each view."""
        arrays = self.rasteriser.loaded(model.drawn(self.smooth))
        for level in self.levels():
            forward = self.rasteriser.forward(arrays, level.camera, self.settings)
            image = forward.image[:3]
            target = target_of(level, image, self.settings.background)
            scale = np.float32(1 / 255 if target.dtype == np.uint8 else 1)
            error = np.ascontiguousarray(target * scale - image, np.float32)
            ignore_masked(level, error)
            yield forward, error

    def _add(
        self,
        forward: object,
        v_image: NDArray[np.float32],
        total: NDArray[np.float64],
        absolute: bool = False,
    ) -> None:
        """Add the gradient of each coefficient by `v_image`, or its absolute value, to `total`
        [N, coefficients, 3]."""
        backward = self.rasteriser.backward(forward, v_image)
        found = backward.parameters[:, SH : used_columns(total.shape[1])]
        found = found.reshape(len(found), *total.shape[1:])
        total[backward.rows] += np.abs(found) if absolute else found


def needs_colour_refit(dropout: bool, views: int) -> bool:
    """Whether training used dropout, on few enough views for a refit to be worthwhile."""
    return dropout and views <= MAX_REFIT_VIEWS


def _huber_weights(error: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 for errors up to HUBER_THRESHOLD, less beyond."""
    threshold = np.float32(HUBER_THRESHOLD)
    return np.asarray(threshold / np.maximum(np.abs(error), threshold), np.float32)
