"""Where a photograph was taken, from Exif and from DJI's XMP."""

from __future__ import annotations

import io

import pytest
from PIL import Image

from stages.ingest.exif import read_exif
from stages.ingest.gps import read_gps

EXIF = {1: "N", 2: (47, 30, 36), 3: "E", 4: (8, 0, 0), 5: b"\x00", 6: 431.5}  # 47.51, 8
PACKET = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description rdf:about="DJI Meta Data"
   xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
   drone-dji:GpsStatus="RTK"
   drone-dji:AltitudeType="RtkAlt"
   drone-dji:GpsLatitude="{latitude}"
   drone-dji:GpsLongitude="{longitude}"
   drone-dji:AbsoluteAltitude="+478.123"
   drone-dji:RelativeAltitude="+60.1"
   drone-dji:RtkFlag="{flag}"
   drone-dji:RtkStdLon="0.01215"
   drone-dji:RtkStdLat="0.01412"
   drone-dji:RtkStdHgt="0.02955"
   drone-dji:SurveyingMode="1"/></rdf:RDF></x:xmpmeta>"""


def packet(latitude: str = "+47.510012345", longitude: str = "+8.000023456", flag: str = "50"):
    return PACKET.format(latitude=latitude, longitude=longitude, flag=flag).encode()


def test_a_corrected_position_has_more_digits_a_height_and_an_error() -> None:
    found = read_gps(EXIF, packet())
    assert found.position == (47.510012345, 8.000023456)
    assert (found.height, found.error_m) == (478.123, 0.01412)


def test_values_in_elements_are_read_as_those_in_attributes() -> None:
    text = packet().decode()
    for name in ("GpsLatitude", "GpsLongitude", "RtkFlag", "AbsoluteAltitude"):
        text = text.replace(f'drone-dji:{name}="', f"<drone-dji:{name}>")
    assert read_gps({}, text.encode()).position == (47.510012345, 8.000023456)


def test_the_misspelt_longitude_of_older_aircraft_is_read() -> None:
    old = packet().replace(b"GpsLongitude", b"GpsLongtitude")
    assert read_gps({}, old).position == (47.510012345, 8.000023456)


@pytest.mark.parametrize("flag", ["0", "16", "", "x"])
def test_a_position_without_correction_is_that_of_exif(flag: str) -> None:
    found = read_gps(EXIF, packet(flag=flag))
    assert (found.position, found.height, found.error_m) == ((47.51, 8.0), 431.5, None)


def test_tags_that_state_two_places_give_none() -> None:
    """By hand: 0.001 degrees of latitude are 111 m."""
    found = read_gps(EXIF, packet(latitude="+47.511"))
    assert (found.position, found.contradicts) == (None, True)
    assert not read_gps(EXIF, packet(latitude="+47.5103")).contradicts


@pytest.mark.parametrize(
    "damaged",
    [
        packet(latitude="north"), packet(latitude="+97"), packet(longitude="nan"),
        packet(latitude="0", longitude="0"), packet()[:200], b"\xff\x00" * 50, b"",
    ],
)  # fmt: skip
def test_damaged_xmp_counts_as_none(damaged: bytes) -> None:
    assert read_gps(EXIF, damaged).position == (47.51, 8.0)
    assert read_gps({}, damaged).position is None


@pytest.mark.parametrize(
    ("side", "height"), [(b"\x00", 431.5), (b"\x01", -431.5), (1, -431.5), ("1", -431.5)]
)
def test_heights_below_sea_level_are_negative(side: object, height: float) -> None:
    assert read_gps(EXIF | {5: side}, b"").height == height


def test_the_packet_is_found_in_a_jpeg() -> None:
    data = io.BytesIO()
    Image.new("RGB", (80, 60)).save(data, "JPEG", xmp=packet())
    with Image.open(data) as image:
        assert read_exif(image).gps.error_m == 0.01412
