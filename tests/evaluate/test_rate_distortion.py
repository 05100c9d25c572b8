"""The number of independent samples in photographs, and the cost of a parameter."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from stages.evaluate.rate_distortion import RateDistortion, independent_share


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(40, 64, 64, 3))


def test_noise_counts_in_full() -> None:
    assert independent_share([noise()]) == pytest.approx(1.0, abs=0.05)


def test_grey_noise_is_a_third() -> None:
    grey = noise()[..., :1] * np.ones(3)
    assert independent_share([grey]) == pytest.approx(1 / 3, rel=0.05)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_a_blur_leaves_as_many_as_its_correlation_implies(sigma: float) -> None:
    """Of a Gaussian blur the correlation is a Gaussian of variance 2 sigma^2, and the integral of
    its square 2 pi sigma^2."""
    blurred = np.stack([cv2.GaussianBlur(tile, (0, 0), sigma) for tile in noise()])
    wanted = 1 / (2 * math.pi * sigma**2)
    assert independent_share([blurred]) == pytest.approx(wanted, rel=0.1)


def test_the_lagrange_multiplier_is_the_slope_of_the_code_length() -> None:
    rate = RateDistortion(samples=1_000_000, independent_samples=1e5, sse=1000.0)

    def bits(sse: float) -> float:
        return 0.5 * rate.independent_samples * math.log2(sse / rate.samples)

    saved = bits(rate.sse) - bits(rate.sse - 1e-3 * rate.sse_per_parameter)
    assert saved == pytest.approx(1e-3 * rate.bits_per_parameter, rel=1e-3)
    one_db = bits(rate.sse) - bits(rate.sse * 10**-0.1)
    assert one_db == pytest.approx(rate.bits_per_db)
