"""Focal length and exposure from EXIF."""

from __future__ import annotations

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from stages.ingest.exif import Exif, read_exif
from tests.ingest.made_files import exif


def read_back(tags: Image.Exif, size: tuple[int, int] = (80, 60)) -> Exif:
    data = io.BytesIO()
    Image.new("RGB", size).save(data, "JPEG", exif=tags)
    with Image.open(data) as image:
        return read_exif(image)


def test_the_tags_of_a_camera_are_read() -> None:
    facts = read_back(exif(orientation=6, focal_35mm=27, width=80, height=60))
    assert (facts.make, facts.model, facts.orientation) == ("Maker", "Camera 7", 6)
    assert (facts.focal_mm, facts.focal_35mm, facts.pixels) == (5.0, 27.0, (80.0, 60.0))


def test_focal_length_from_the_35mm_equivalent_follows_the_longer_side() -> None:
    facts = Exif(focal_35mm=27.0)
    assert facts.focal_px((4000, 3000), 1600, 1200) == pytest.approx(1200.0)
    assert facts.focal_px((4000, 3000), 1200, 1600) == pytest.approx(1200.0), "turned"


def test_focal_length_from_the_sensor_resolution_needs_the_cameras_own_size() -> None:
    """24 mm on a sensor of 24 mm width, 6000 pixels: the focal length is the width."""
    tags = exif(
        focal=IFDRational(24), focal_35mm=None, plane_x=IFDRational(6350), plane_unit=2,
        width=6000, height=4000,
    )  # fmt: skip
    facts = read_back(tags)
    assert facts.focal_px((6000, 4000), 1500, 1000) == pytest.approx(1500.0)
    assert facts.focal_px((1500, 1000), 1500, 1000) is None, "resized: the tag is stale"


def test_a_cropped_photograph_has_no_focal_length() -> None:
    facts = read_back(exif(width=4000, height=3000))
    assert facts.focal_px((4000, 2000), 1600, 800) is None
    assert facts.focal_px((3000, 4000), 1200, 1600) is not None


def test_exposure_value_is_sunny_sixteen() -> None:
    """1/125 s at f/16, ISO 100 is EV 15 (log2(256 x 125) = 14.97); ISO 200 is a stop less."""
    facts = Exif(exposure_s=1 / 125, f_number=16.0, iso=100.0)
    assert facts.exposure_ev == pytest.approx(14.966, abs=1e-3)
    assert Exif(exposure_s=1 / 125, f_number=16.0, iso=200.0).exposure_ev == pytest.approx(
        13.966, abs=1e-3
    )
    assert Exif(exposure_s=1 / 125, f_number=16.0).exposure_ev is None


@pytest.mark.parametrize(
    "bad",
    [
        {"focal_35mm": 0}, {"focal_35mm": 65535, "focal": IFDRational(0, 0)},
        {"exposure": IFDRational(1, 0)}, {"f_number": IFDRational(0, 1)}, {"iso": 0},
        {"orientation": 99}, {"make": "\x01\0garbage"}, {"width": 0, "height": 5},
    ],
)  # fmt: skip
def test_senseless_tags_count_as_missing(bad: dict[str, Any]) -> None:
    facts = read_back(exif(**bad))
    focal = facts.focal_px((80, 60), 80, 60)
    assert focal is None or 16 < focal < 2400
    assert facts.orientation == 1
    assert facts.make.isprintable()
    if {"exposure", "f_number", "iso"} & set(bad):
        assert facts.exposure_ev is None


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
@given(st.binary(max_size=200), st.integers(0, 150))
def test_damaged_exif_is_no_exception(noise: bytes, start: int) -> None:
    good = exif(orientation=6).tobytes()
    image = Image.new("RGB", (80, 60))
    image.info["exif"] = good[:start] + noise + good[start + len(noise) :]
    facts = read_exif(image)
    assert facts.orientation in range(1, 9)
    facts.camera_key(80, 60)
    assert facts.exposure_ev is None or abs(facts.exposure_ev) < 200


def test_the_camera_key_tells_zooms_and_sizes_apart() -> None:
    keys = {
        read_back(exif(focal=IFDRational(focal))).camera_key(*size)
        for focal in (24, 35)
        for size in ((80, 60), (60, 80))
    }
    assert len(keys) == 4
    assert read_back(exif(make="Leica, Inc.")).camera_key(80, 60).startswith("Leica  Inc.")
