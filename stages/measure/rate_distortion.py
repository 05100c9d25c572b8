"""What one number of the model may cost, told by the photographs themselves.

Two-part code length: bits of the model + (n / 2) log2(MSE), n the independent colour samples in the
photographs. A number tells a value that n samples determine, which takes log2(n) / 2 bits; so it is
worth keeping if the squared error that it saves is worth as many.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from stages.measure.evaluation import EvaluationView, ImageRenderer

_TILE = 64  # pixels: residuals farther apart have nothing to do with each other


@dataclass(frozen=True)
class RateDistortion:
    """independent: colour samples that tell as much as the photographs' `samples`, whose residuals
    resemble their neighbours'. sse: summed squared error now."""

    samples: int
    independent_samples: float
    sse: float

    def scaled(self, times: float) -> RateDistortion:
        """For as many times the photographs, which tell as much each."""
        return RateDistortion(
            round(self.samples * times), self.independent_samples * times, self.sse * times
        )

    @property
    def bits_per_parameter(self) -> float:
        return 0.5 * math.log2(max(2.0, self.independent_samples))

    @property
    def bits_per_db(self) -> float:
        """What one dB of PSNR is worth."""
        return self.independent_samples * 0.05 * math.log2(10)

    @property
    def sse_per_parameter(self) -> float:
        """The squared error that a number must save to pay: the slope of the code length."""
        return (
            self.bits_per_parameter
            * 2
            * math.log(2)
            * self.sse
            / max(1.0, self.independent_samples)
        )


def rate_distortion_of(
    draw: ImageRenderer, photographs: Iterable[EvaluationView]
) -> RateDistortion:
    """The price at what `draw` has reached of the photographs."""
    samples, sse, tiles = 0, 0.0, []
    for photograph in photographs:
        residual = np.clip(draw(photograph.camera), 0.0, 1.0) - photograph.image
        kept = photograph.kept
        if kept is not None:
            residual *= kept[..., None]
        samples += residual.size if kept is None else 3 * int(kept.sum())
        sse += float(np.square(residual, dtype=np.float64).sum())
        tiles.append(_tiles(residual))
    return RateDistortion(samples, samples * independent_share(tiles), sse)


def _tiles(residual: NDArray[np.floating]) -> NDArray[np.float32]:
    """[tiles, side, side, 3] whole ones; a smaller picture is one, cut square."""
    side = min(_TILE, *residual.shape[:2])
    high, wide = (length // side for length in residual.shape[:2])
    whole = residual[: high * side, : wide * side].reshape(high, side, wide, side, 3)
    return np.ascontiguousarray(whole.swapaxes(1, 2), np.float32).reshape(-1, side, side, 3)


def independent_share(pictures: Sequence[NDArray[np.floating]]) -> float:
    """How many of the samples, of each picture [tiles, side, side, 3], would tell their mean square
    as well if they were independent: 1 / the sum of squared correlations with all samples around,
    which is read off the mean power spectrum; colours along the axes on which they do not
    correlate."""
    flats = (tiles.reshape(-1, 3).astype(np.float64) for tiles in pictures)
    _, axes = np.linalg.eigh(sum(flat.T @ flat for flat in flats))
    power = np.zeros(pictures[0].shape[1:])
    for tile in chain.from_iterable(pictures):
        power += np.abs(np.fft.fft2(tile @ axes, axes=(0, 1))) ** 2
    total = power.sum()
    return float(total**2 / (power.size * np.square(power).sum())) if total > 0 else 1.0
