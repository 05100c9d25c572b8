"""Exif tags about camera, lens, exposure and place (Exif 2.32, CIPA DC-008)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from stages.ingest.gps import Gps, number_of, read_gps, text_of
from stages.ingest.panorama import projection_of

FULL_FRAME_WIDTH_MM = 36.0
_EXIF_IFD, _INTEROPERABILITY_IFD, _GPS_IFD = 0x8769, 0xA005, 0x8825
_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SENSOR_WIDTHS_MM = (2.0, 70.0)  # smallest phone cameras to medium format
_FOCAL_OVER_LONG_SIDE = (0.2, 30.0)  # from fisheye to long telephoto


@dataclass(frozen=True)
class Exif:
    """The tags that are used; None or "" where missing or invalid.

    Args:
        make, model, lens: Make, Model, LensModel.
        orientation: Orientation, 1 to 8.
        focal_mm: FocalLength.
        focal_35mm: FocalLengthIn35mmFilm.
        exposure_s: ExposureTime.
        f_number: FNumber.
        iso: PhotographicSensitivity.
        pixels: (PixelXDimension, PixelYDimension), the size that the camera wrote.
        focal_plane_px_per_mm: FocalPlaneXResolution in pixels per millimetre.
        adobe_rgb: whether the colour space is declared as Adobe RGB without a profile
            (InteroperabilityIndex "R03" of DCF).
        gps: where it was taken.
        projection: of a panorama, see `panorama.projection_of`.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    orientation: int = 1
    focal_mm: float | None = None
    focal_35mm: float | None = None
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    pixels: tuple[float, float] | None = None
    focal_plane_px_per_mm: float | None = None
    adobe_rgb: bool = False
    gps: Gps = field(default_factory=Gps)
    projection: str = ""

    @property
    def exposure_ev(self) -> float | None:
        """Exposure value at ISO 100: log2(N^2 / t) - log2(ISO / 100). One stop less light is one EV
        more."""
        if self.exposure_s is None or self.f_number is None or self.iso is None:
            return None
        # Logarithms one by one: tags may hold values whose square or quotient float64 cannot.
        film = math.log2(self.iso) - math.log2(100.0)
        return 2 * math.log2(self.f_number) - math.log2(self.exposure_s) - film

    def focal_px(self, stored: tuple[int, int], width: int, height: int) -> float | None:
        """Focal length in pixels of the normalised picture; None for a cropped file.

        It comes from the 35 mm equivalent, taken along the longer side (36 mm). Else it comes from
        the sensor's resolution, but only if the file still has the size that the camera wrote:
        programs that resize leave that tag as it was.

        Args:
            stored: (width, height) in the file.
            width, height: of the normalised picture, upright.
        """
        longer = max(width, height)
        if self._cropped(stored):
            return None
        focal = None
        if self.focal_35mm is not None:
            focal = self.focal_35mm / FULL_FRAME_WIDTH_MM * longer
        elif self.focal_mm is not None and self._sensor_width_is_valid(stored):
            assert self.focal_plane_px_per_mm is not None
            focal = self.focal_mm * self.focal_plane_px_per_mm * longer / max(stored)
        low, high = _FOCAL_OVER_LONG_SIDE
        return focal if focal is not None and low < focal / longer < high else None

    def camera_key(self, width: int, height: int) -> str:
        """Equal for photographs of the same camera, lens setting and picture size."""
        name = " ".join(part for part in (self.make, self.model, self.lens) if part)
        name = name.replace(",", " ")  # the comma divides the parts of the key
        focal = f"{self.focal_mm:.1f} mm" if self.focal_mm else ""
        equivalent = f"{self.focal_35mm:.0f} mm equivalent" if self.focal_35mm else ""
        size = f"{width}x{height}"
        return ", ".join(part for part in (name or "unknown", focal, equivalent, size) if part)

    def _cropped(self, stored: tuple[int, int]) -> bool:
        """Whether the picture no longer has the proportions that the camera wrote."""
        if self.pixels is None:
            return False
        was = max(self.pixels) / min(self.pixels)
        return abs(was / (max(stored) / min(stored)) - 1.0) > 0.02

    def _sensor_width_is_valid(self, stored: tuple[int, int]) -> bool:
        if self.pixels is None or self.focal_plane_px_per_mm is None:
            return False
        low, high = _SENSOR_WIDTHS_MM
        same_size = sorted(self.pixels) == sorted(stored)
        return same_size and low < max(stored) / self.focal_plane_px_per_mm < high


def read_exif(image: Any) -> Exif:
    """The tags of an open PIL image. Damaged Exif counts as none, because many cameras write it
    wrongly."""
    try:
        main = image.getexif()
        tags = {**dict(main), **dict(main.get_ifd(_EXIF_IFD))}
    except Exception:  # Pillow's parsers raise whatever the damage leads to
        return Exif()
    xmp = getattr(image, "info", {}).get("xmp")
    xmp = xmp if isinstance(xmp, bytes) else b""
    orientation = _number(tags.get(0x0112))
    width, height = _number(tags.get(0xA002)), _number(tags.get(0xA003))
    return Exif(
        make=_text(tags.get(0x010F)),
        model=_text(tags.get(0x0110)),
        lens=_text(tags.get(0xA434)),
        orientation=int(orientation) if orientation and orientation in range(1, 9) else 1,
        focal_mm=_number(tags.get(0x920A)),
        focal_35mm=_number(tags.get(0xA405)),
        exposure_s=_number(tags.get(0x829A)),
        f_number=_number(tags.get(0x829D)),
        iso=_iso(tags),
        pixels=(width, height) if width and height else None,
        focal_plane_px_per_mm=_focal_plane_px_per_mm(tags),
        adobe_rgb=_text(_ifd(main, _INTEROPERABILITY_IFD).get(1)) == "R03",
        gps=read_gps(_ifd(main, _GPS_IFD), xmp),
        projection=projection_of(xmp),
    )


def _ifd(main: Any, number: int) -> dict[int, Any]:
    """The tags of a directory; none if it is missing or damaged."""
    try:
        return dict(main.get_ifd(number))
    except Exception:  # before Pillow 13 also where there is none
        return {}


def _iso(tags: dict[int, Any]) -> float | None:
    """PhotographicSensitivity; RecommendedExposureIndex where that is 65535, its largest value."""
    iso = _number(tags.get(0x8827))
    return _number(tags.get(0x8832)) if iso == 65535 else iso


def _focal_plane_px_per_mm(tags: dict[int, Any]) -> float | None:
    resolution = _number(tags.get(0xA20E))
    unit = _PLANE_UNIT_MM.get(int(_number(tags.get(0xA210)) or 2))
    return resolution / unit if resolution and unit else None


def _number(value: Any) -> float | None:
    """A positive finite number, or None."""
    if isinstance(value, tuple | list):
        value = value[0] if value else None
    number = number_of(value)
    return number if number is not None and number > 0 else None


def _text(value: Any) -> str:
    """Printable text on one line, at most 80 characters."""
    kept = "".join(c if c.isprintable() else " " for c in text_of(value).split("\0")[0])
    return " ".join(kept.split())[:80]
