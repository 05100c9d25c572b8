"""Converts video frames to 8-bit sRGB: matrix coefficients, range, primaries and HDR transfer.

Code points are those of ITU-T H.273. Where a video declares none, the usual defaults of players
apply.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.ingest.colour import HDR_TRANSFERS, P3, P3_TO_SRGB, srgb_encoded

_FULL_RANGE = 2
_PQ, _HLG = HDR_TRANSFERS
_BT2020 = 9
_KR_KB = {  # by MatrixCoefficients
    1: (0.2126, 0.0722),  # BT.709
    4: (0.30, 0.11),  # FCC
    5: (0.299, 0.114),  # BT.601
    6: (0.299, 0.114),
    7: (0.212, 0.087),  # SMPTE 240M
    9: (0.2627, 0.0593),  # BT.2020
    10: (0.2627, 0.0593),
}
_HD_HEIGHT = 720  # from here on, BT.709 unless declared otherwise
# Linear RGB to linear sRGB, white point D65. From the primaries in BT.2020.
_TO_SRGB = {
    _BT2020: np.array(
        [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349],
         [-0.018151, -0.100579, 1.118730]]
    ),
    P3: P3_TO_SRGB,
}  # fmt: skip
_BT2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
# cd/m2. Peak of the HLG reference display and of most PQ video; HDR reference white (BT.2408).
PEAK, WHITE = 1000.0, 203.0


@dataclass(frozen=True)
class Colours:
    """The code points that a video declares: MatrixCoefficients, TransferCharacteristics,
    ColourPrimaries, and FFmpeg's colour range."""

    matrix: int
    transfer: int
    primaries: int
    range: int

    @classmethod
    def of(cls, context: Any) -> Colours:
        """From a PyAV codec context: not every version has them on frames."""
        return cls(
            int(context.colorspace),
            int(context.color_trc),
            int(context.color_primaries),
            int(context.color_range),
        )

    @property
    def hdr(self) -> bool:
        return self.transfer in (_PQ, _HLG)

    @property
    def conversion(self) -> str:
        """How they are converted to sRGB, in words."""
        if self.hdr:
            return (
                f"{'PQ' if self.transfer == _PQ else 'HLG'} (BT.2100), tone mapped as in BT.2390 "
                f"from {PEAK:,.0f} to {WHITE:.0f} cd/m2, BT.2020 primaries to sRGB"
            )
        if self.primaries in _TO_SRGB:
            return {_BT2020: "BT.2020", P3: "Display P3"}[self.primaries] + " to sRGB"
        return "read as sRGB"


def srgb(frame: Any, colours: Colours, width: int, height: int) -> NDArray[np.uint8]:
    """A PyAV frame, scaled to [height, width, 3]."""
    encoded = _encoded_rgb(frame, colours, width, height)
    hdr = colours.hdr
    matrix = _TO_SRGB.get(_BT2020 if hdr else colours.primaries)
    if matrix is not None:
        for top in range(0, height, 256):  # strips: a float64 copy of it all would be large
            rows = np.clip(encoded[top : top + 256], 0.0, 1.0).astype(np.float64)
            linear = _tone_mapped(colours.transfer, rows) if hdr else rows**2.4
            linear = np.clip(linear @ matrix.T, 0.0, 1.0)
            encoded[top : top + 256] = srgb_encoded(linear) if hdr else linear ** (1 / 2.4)
    return np.rint(np.clip(encoded, 0.0, 1.0) * 255).astype(np.uint8)


def _encoded_rgb(frame: Any, colours: Colours, width: int, height: int) -> NDArray[np.float32]:
    """[H, W, 3] non-linear R'G'B' in the video's own encoding, nominally 0 to 1."""
    name, bits = frame.format.name, frame.format.components[0].bits
    if not name.startswith(("yuv", "nv", "p0", "p2", "uyvy", "yuyv")):  # RGB, grey, a palette
        rgb = frame.reformat(width, height, "rgb48le", interpolation="LANCZOS")
        return np.asarray(rgb.to_ndarray() / 65535, np.float32)
    deep = bits > 8
    full = name.startswith("yuvj") or colours.range == _FULL_RANGE
    planar = "yuv444p16le" if deep else "yuvj444p" if name.startswith("yuvj") else "yuv444p"
    scaled = frame.reformat(width, height, planar, interpolation="LANCZOS")
    y, cb, cr = (_samples(plane, np.uint16 if deep else np.uint8) for plane in scaled.planes)
    unit = 256 if deep else 1
    top, grey = 256 * unit - 1, 128 * unit
    black, white, chroma = (0, top, top) if full else (16 * unit, 219 * unit, 224 * unit)
    luma, blueness, redness = (y - black) / white, (cb - grey) / chroma, (cr - grey) / chroma
    kr, kb = _KR_KB.get(colours.matrix) or _KR_KB[_default_matrix(frame, colours)]
    red, blue = luma + 2 * (1 - kr) * redness, luma + 2 * (1 - kb) * blueness
    green = (luma - kr * red - kb * blue) / (1 - kr - kb)
    return np.stack([red, green, blue], axis=-1).astype(np.float32)


def _samples(plane: Any, kind: type) -> NDArray[np.float32]:
    """[H, W] of a plane, whose rows may be padded."""
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height]
    return np.ascontiguousarray(rows).view(kind)[:, : plane.width].astype(np.float32)


def _default_matrix(frame: Any, colours: Colours) -> int:
    if colours.hdr:
        return _BT2020
    return 1 if min(frame.width, frame.height) >= _HD_HEIGHT else 6


def _tone_mapped(transfer: int, signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] linear BT.2020 of an SDR display, 1 its white, from an HDR signal [..., 3]."""
    linear = pq_eotf(signal) if transfer == _PQ else hlg_eotf(signal)
    brightest = linear.max(axis=-1, keepdims=True)
    return np.asarray(linear * eetf(brightest) / np.maximum(brightest, 1e-6) / WHITE)


def pq_eotf(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """cd/m2 of a PQ signal in 0..1 (EOTF of SMPTE ST 2084)."""
    power = signal ** (32 / 2523)
    ratio = np.maximum(power - 3424 / 4096, 0.0) / (2413 / 128 - 2392 / 128 * power)
    return 10_000.0 * ratio ** (16384 / 2610)


def _pq_inverse_eotf(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    power = (linear / 10_000.0) ** (2610 / 16384)
    return np.asarray(
        ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    )


def hlg_eotf(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] cd/m2 of an HLG signal in 0..1 on a display of 1,000 cd/m2 (EOTF of BT.2100)."""
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    luminance = scene @ _BT2020_LUMINANCE
    return np.asarray(PEAK * np.maximum(luminance, 0.0)[..., None] ** 0.2 * scene)


def eetf(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tone mapping of cd/m2 from `PEAK` to `WHITE`, without change of dark colours: the EETF of
    BT.2390, section 5.4.1, a Hermite spline above its knee."""
    peak, white = _pq_inverse_eotf(np.array([PEAK, WHITE]))
    signal = np.minimum(_pq_inverse_eotf(linear) / peak, 1.0)
    most = white / peak
    knee = 1.5 * most - 0.5
    t = np.clip((signal - knee) / (1 - knee), 0.0, 1.0)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee
        + (t**3 - 2 * t**2 + t) * (1 - knee)
        + (3 * t**2 - 2 * t**3) * most
    )
    return pq_eotf(np.where(signal < knee, signal, spline) * peak)
