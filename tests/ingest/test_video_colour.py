"""Colours of video frames."""

from __future__ import annotations

import av
import numpy as np
import pytest

from stages.ingest.video_colour import PEAK, WHITE, Colours, eetf, hlg_eotf, pq_eotf, srgb

PATCHES = np.array(
    [[250, 20, 20], [20, 250, 20], [20, 20, 250], [128, 128, 128], [250, 250, 250], [10, 10, 10],
     [200, 150, 100], [90, 160, 210]], np.uint8
)  # fmt: skip


def chart() -> np.ndarray:
    """[64, 128, 3] of patches 16 px wide."""
    return np.ascontiguousarray(np.repeat(np.repeat(PATCHES[None], 16, axis=1), 64, axis=0))


def patches(pixels: np.ndarray) -> np.ndarray:
    """The middle of each patch."""
    return pixels[32, 8::16]


LAYOUTS = (
    *("yuv420p", "yuv422p", "yuv444p", "yuvj420p", "nv12"),
    *("yuv420p10le", "p010le", "yuv444p12le", "gbrp"),
)


@pytest.mark.parametrize("pixel_format", LAYOUTS)
def test_colours_come_back_in_every_layout_and_depth(pixel_format: str) -> None:
    full = pixel_format.startswith("yuvj")
    frame = av.VideoFrame.from_ndarray(chart(), format="rgb24").reformat(
        format=pixel_format, dst_colorspace="ITU709", dst_color_range="JPEG" if full else "MPEG"
    )
    colours = Colours(matrix=1, transfer=1, primaries=1, range=2 if full else 1)
    found = patches(srgb(frame, colours, 128, 64))
    assert np.abs(found.astype(int) - PATCHES).max() <= 3


HLG = Colours(matrix=9, transfer=18, primaries=9, range=1)
PQ = Colours(matrix=9, transfer=16, primaries=9, range=1)


def signal_frame(signal: np.ndarray) -> av.VideoFrame:
    """10 bits, BT.2020's matrix, limited range, of R'G'B' [3]."""
    red, green, blue = signal
    y = 0.2627 * red + 0.678 * green + 0.0593 * blue
    values = (64 + 876 * y, 512 + 896 * (blue - y) / 1.8814, 512 + 896 * (red - y) / 1.4746)
    planes = np.stack([np.full((32, 32), 64 * round(v), np.uint16) for v in values], axis=-1)
    return av.VideoFrame.from_ndarray(planes, format="yuv444p16le").reformat(format="yuv444p10le")


def test_hlg_and_pq_curves_pass_through_the_values_of_the_standards() -> None:
    grey = np.array([[0.75, 0.75, 0.75], [1.0, 1.0, 1.0], [0.5, 0.5, 0.5]])
    assert hlg_eotf(grey)[:, 0] == pytest.approx([203, 1000, 50.7], rel=0.01)  # BT.2408, table 1
    signals = np.array([0.58, 0.7518, 0.5081, 1.0])
    assert pq_eotf(signals) == pytest.approx([202, 1000, 100, 10_000], rel=0.01)


def test_the_roll_off_keeps_what_is_dark_and_never_turns_round() -> None:
    light = np.linspace(0, PEAK, 500)
    out = eetf(light)
    assert out[light < 80] == pytest.approx(light[light < 80], rel=1e-3, abs=1e-3)
    assert (np.diff(out) > 0).all()
    assert out[-1] == pytest.approx(WHITE, rel=1e-3)


@pytest.mark.parametrize(("colours", "white", "peak"), [(HLG, 0.75, 1.0), (PQ, 0.58, 0.7518)])
def test_reference_white_of_hdr_is_a_bright_grey_and_its_peak_is_white(
    colours: Colours, white: float, peak: float
) -> None:
    shown = srgb(signal_frame(np.full(3, white)), colours, 32, 32)
    assert 220 <= shown.mean() <= 240
    assert np.ptp(shown) <= 2
    assert srgb(signal_frame(np.full(3, peak)), colours, 32, 32).min() >= 253


def test_wide_colours_come_out_as_the_srgb_colour_that_they_stand_for() -> None:
    """sRGB's red at 50 cd/m2, as PQ in BT.2020 primaries."""
    light = 50 * np.array([0.6274, 0.0691, 0.0164])
    power = (light / 10_000) ** (2610 / 16384)
    signal = ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    shown = srgb(signal_frame(signal), PQ, 32, 32)[0, 0].astype(int)
    expected = 255 * (1.055 * (50 / WHITE) ** (1 / 2.4) - 0.055)
    assert abs(shown[0] - expected) < 4
    assert max(shown[1:]) < 20


def test_the_mapping_is_named() -> None:
    assert "HLG" in HLG.conversion
    assert "BT.2390" in PQ.conversion
    assert Colours(1, 1, 1, 1).conversion == "read as sRGB"
