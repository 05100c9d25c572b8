"""How many bits a parameter of the model may cost: the rate-distortion trade-off of the views.

Two-part code length (Rissanen's minimum description length): bits of the model + (n / 2) log2(MSE),
where n is the number of independent colour samples in the photographs. A parameter that n samples
determine takes log2(n) / 2 bits. It is worth keeping if the squared error that it saves shortens
the second part by as many bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.evaluation import EvaluationView, ImageRenderer

_TILE = 64  # pixels: residuals farther apart are not correlated


@dataclass(frozen=True)
class RateDistortion:
    """The exchange rate between bits and squared error.

    Args:
        samples: colour samples of the photographs.
        independent_samples: the number of independent samples that hold the same information;
            residuals of neighbouring pixels are correlated.
        sse: summed squared error of the present drawings.
    """

    samples: int
    independent_samples: float
    sse: float

    def scaled(self, times: float) -> RateDistortion:
        """The exchange rate for `times` as many photographs like these."""
        return RateDistortion(
            round(self.samples * times), self.independent_samples * times, self.sse * times
        )

    @property
    def bits_per_parameter(self) -> float:
        return 0.5 * math.log2(max(2.0, self.independent_samples))

    @property
    def bits_per_db(self) -> float:
        """Bits equivalent to one dB of PSNR."""
        return self.independent_samples * 0.05 * math.log2(10)

    @property
    def sse_per_parameter(self) -> float:
        """The Lagrange multiplier: the squared error that a parameter must save to be kept, which
        is the slope of the code length."""
        bits, independent = self.bits_per_parameter, max(1.0, self.independent_samples)
        return bits * 2 * math.log(2) * self.sse / independent


def rate_distortion_of(draw: ImageRenderer, views: Iterable[EvaluationView]) -> RateDistortion:
    """The exchange rate at the squared error that `draw` has now."""
    samples, sse, tiles = 0, 0.0, []
    for view in views:
        residual = np.clip(draw(view.camera), 0.0, 1.0) - view.image
        valid = view.valid
        if valid is not None:
            residual *= valid[..., None]
        samples += residual.size if valid is None else 3 * int(valid.sum())
        sse += float(np.square(residual, dtype=np.float64).sum())
        tiles.append(_tiles(residual))
    return RateDistortion(samples, samples * independent_share(tiles), sse)


def _tiles(residual: NDArray[np.floating]) -> NDArray[np.float32]:
    """[T, S, S, 3] whole tiles of a residual [H, W, 3]; S is at most the size of the picture."""
    side = min(_TILE, *residual.shape[:2])
    high, wide = (length // side for length in residual.shape[:2])
    whole = residual[: high * side, : wide * side].reshape(high, side, wide, side, 3)
    return np.ascontiguousarray(whole.swapaxes(1, 2), np.float32).reshape(-1, side, side, 3)


def independent_share(residuals: Sequence[NDArray[np.floating]]) -> float:
    """The effective sample size, as a share of the samples: the number of independent samples that
    would estimate the mean square equally well.

    It is 1 / the sum of squared correlations of a sample with all others, read off the mean power
    spectrum of the tiles, with colours along axes on which they are not correlated.

    Args:
        residuals: of each picture, [T, S, S, 3].
    """
    flats = (tiles.reshape(-1, 3).astype(np.float64) for tiles in residuals)
    _, axes = np.linalg.eigh(sum(flat.T @ flat for flat in flats))
    power = np.zeros(residuals[0].shape[1:])
    for tile in chain.from_iterable(residuals):
        power += np.abs(np.fft.fft2(tile @ axes, axes=(0, 1))) ** 2
    total = power.sum()
    return float(total**2 / (power.size * np.square(power).sum())) if total > 0 else 1.0
