"""Where a photograph was taken: by the GPS tags of Exif, and by the XMP tags of DJI.

A DJI aircraft that corrects its positions by a base station (RTK) writes them into XMP with more
digits, with the kind of the fix and its standard deviations. `RtkFlag` is 50 for a fixed solution,
34 for a float solution, 16 for a single point and 0 for none.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

_DJI = re.compile(rb"drone-dji:(\w{1,40})\s*(?:=\s*[\"']|>)\s*([^\"'<]{1,40})")
_CORRECTED = (34.0, 50.0)
_FARTHEST_M = (
    50.0  # between both positions of one photograph, above an aircraft's error without RTK
)
_DEGREE_M = 111_320.0  # of a meridian, about
_HIGHEST_M = 100_000.0


@dataclass(frozen=True)
class Gps:
    """A position; all None where there is none.

    Args:
        position: latitude and longitude in degrees, north and east positive.
        height: metres, above what the receiver measures from: often sea level, with RTK the
            ellipsoid.
        error_m: the larger standard deviation of the horizontal position, metres.
        contradicts: whether Exif and XMP state places far apart; then there is no position.
    """

    position: tuple[float, float] | None = None
    height: float | None = None
    error_m: float | None = None
    contradicts: bool = False


def read_gps(tags: dict[int, Any], xmp: bytes) -> Gps:
    """The position of a photograph. Damaged tags count as none.

    Args:
        tags: of Exif's GPS IFD.
        xmp: the XMP packet; b"" for none.
    """
    by_exif, by_xmp = _from_exif(tags), _from_dji(xmp)
    if by_exif.position is None or by_xmp.position is None:
        return by_exif if by_xmp.position is None else by_xmp
    (north, east), (north2, east2) = by_exif.position, by_xmp.position
    across = math.remainder(east - east2, 360.0) * math.cos(math.radians(north))
    if math.hypot(north - north2, across) * _DEGREE_M > _FARTHEST_M:
        return Gps(contradicts=True)
    return by_xmp


def _from_exif(tags: dict[int, Any]) -> Gps:
    """The position; none at 0, 0 either, which receivers without a fix write."""
    angles = []
    for reference, number in ((1, 2), (3, 4)):
        sign = {"N": 1, "E": 1, "S": -1, "W": -1}.get(text_of(tags.get(reference)).upper()[:1])
        try:
            degrees, minutes, seconds = (float(part) for part in tags[number])
        except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            return Gps()
        value = degrees + minutes / 60 + seconds / 3600
        if sign is None or not value >= 0:
            return Gps()
        angles.append(sign * value)
    side = tags.get(5)  # a byte, which some programs write as text
    below = side in (1, 3) or text_of(side) in ("\1", "\3", "1", "3")
    height = number_of(tags.get(6))
    return _checked(angles[0], angles[1], -height if height is not None and below else height)


def _from_dji(xmp: bytes) -> Gps:
    """The corrected position; none for a fix without correction, which Exif holds as well."""
    values: dict[str, float | None] = {}
    for name, text in _DJI.findall(xmp):
        values.setdefault(name.decode(), number_of(text.decode("ascii", "replace")))
    if values.get("RtkFlag") not in _CORRECTED:
        return Gps()
    latitude = values.get("GpsLatitude")
    longitude = values.get("GpsLongitude", values.get("GpsLongtitude"))  # older aircraft misspell
    if latitude is None or longitude is None:
        return Gps()
    errors = [values.get("RtkStdLat"), values.get("RtkStdLon")]
    known = [error for error in errors if error is not None and error > 0]
    return _checked(
        latitude, longitude, values.get("AbsoluteAltitude"), max(known) if len(known) == 2 else None
    )


def _checked(
    latitude: float, longitude: float, height: float | None, error_m: float | None = None
) -> Gps:
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)):
        return Gps()
    height = round(height, 9) if height is not None and abs(height) <= _HIGHEST_M else None
    error_m = None if error_m is None else round(error_m, 9)
    return Gps((round(latitude, 9), round(longitude, 9)), height, error_m)


def number_of(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def text_of(value: Any) -> str:
    """Text, or the ASCII in bytes; "" for anything else."""
    if isinstance(value, bytes):
        value = value.decode("ascii", "ignore")
    return value.strip() if isinstance(value, str) else ""
