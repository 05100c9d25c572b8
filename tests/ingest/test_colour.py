"""Conversion of other colour spaces to sRGB."""

from __future__ import annotations

import numpy as np
import pytest

from stages.ingest.colour import adobe_to_srgb, luminance, nclx_is_hdr, nclx_is_p3, p3_to_srgb


@pytest.mark.parametrize("convert", [p3_to_srgb, adobe_to_srgb])
def test_white_and_black_stay(convert) -> None:
    ends = np.array([[[0, 0, 0], [255, 255, 255]]], np.uint8)
    np.testing.assert_array_equal(convert(ends), ends)


def test_p3_greys_stay_because_the_curve_is_that_of_srgb() -> None:
    greys = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    np.testing.assert_array_equal(p3_to_srgb(greys), greys)


@pytest.mark.parametrize(
    ("convert", "green_xy", "red_xy", "gamma"),
    [
        (p3_to_srgb, (0.265, 0.690), (0.680, 0.320), None),
        (adobe_to_srgb, (0.21, 0.71), (0.64, 0.33), 563 / 256),
    ],
)
def test_colours_keep_their_chromaticity(convert, green_xy, red_xy, gamma) -> None:
    """Against matrices derived here from the primaries that the standards give."""

    def to_xyz(red: tuple[float, float], green: tuple[float, float]) -> np.ndarray:
        columns = [(x / y, 1.0, (1 - x - y) / y) for x, y in (red, green, (0.15, 0.06))]
        white = np.array([0.3127 / 0.3290, 1.0, (1 - 0.3127 - 0.3290) / 0.3290])
        return np.array(columns).T * np.linalg.solve(np.array(columns).T, white)

    colours = np.array([[[200, 100, 50], [130, 160, 120], [60, 70, 200]]], np.uint8)
    value = colours[0] / 255
    linear = value**gamma if gamma else ((value + 0.055) / 1.055) ** 2.4
    ours = np.linalg.inv(to_xyz((0.64, 0.33), (0.30, 0.60))) @ to_xyz(red_xy, green_xy) @ linear.T
    expected = 255 * (1.055 * np.clip(ours.T, 0.0032, 1) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(convert(colours)[0], expected, atol=0.51)


def test_code_points_of_heic() -> None:
    assert nclx_is_p3({"color_primaries": 12})
    assert not nclx_is_p3({"color_primaries": 1})
    assert not nclx_is_p3(None)
    assert nclx_is_hdr({"transfer_characteristics": 18})
    assert not nclx_is_hdr({"transfer_characteristics": 13})


def test_luminance_weighs_green_most() -> None:
    primaries = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], np.uint8)
    np.testing.assert_allclose(luminance(primaries)[0], [0.2126, 0.7152, 0.0722], atol=1e-6)
