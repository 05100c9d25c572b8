"""Small films made for tests."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 320, 240


@cache
def wall() -> NDArray[np.uint8]:
    """A long textured wall, to film along."""
    rng = np.random.default_rng(4)
    fine = cv2.GaussianBlur(rng.random((HEIGHT, 2400, 3)), (0, 0), 1.0)
    coarse = cv2.resize(rng.random((12, 120, 3)), (2400, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip((0.6 * coarse + 0.9 * (fine - 0.5)) * 200 + 40, 0, 255).astype(np.uint8)


def at(x: float) -> NDArray[np.uint8]:
    """[H, W, 3] what is seen at `x` pixels along the wall."""
    whole = int(x)
    return np.ascontiguousarray(wall()[:, whole : whole + WIDTH])


def smeared(picture: NDArray[np.uint8], pixels: int = 9) -> NDArray[np.uint8]:
    """As by a camera that moved sideways."""
    return np.asarray(cv2.blur(picture, (pixels, 1)), np.uint8)


def film(
    path: Path,
    pictures: Iterable[NDArray[Any]],
    *,
    pixel_format: str = "yuv420p",
    given: str = "rgb24",
    seconds: Iterable[float] | None = None,
    colours: dict[str, int] | None = None,
    codec: str = "libx264",
    sound: bool = False,
    container_options: dict[str, str] | None = None,
    crf: int = 12,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Path:
    """Encode `pictures` [H, W, 3] at 30 a second, or shown at `seconds`. colours: H.273's numbers
    of the codec context. sound: a track of silence as well. size: of the
    pictures."""
    times = iter(seconds) if seconds is not None else (i / 30 for i in range(10**9))
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream: Any = container.add_stream(codec, rate=30)
        (stream.width, stream.height), stream.pix_fmt = size, pixel_format
        stream.codec_context.time_base = Fraction(1, 90_000)
        if codec == "libx264":
            stream.options = {"crf": str(crf)}
        for name, value in {"colorspace": 1, "color_range": 1, **(colours or {})}.items():
            setattr(stream.codec_context, name, value)
        hum: Any = container.add_stream("aac", rate=48_000) if sound else None
        for picture, second in zip(pictures, times, strict=False):
            frame = av.VideoFrame.from_ndarray(picture, format=given)
            frame = frame.reformat(format=pixel_format, dst_colorspace="ITU709")
            frame.pts, frame.time_base = round(second * 90_000), Fraction(1, 90_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if hum is not None:
            _silence(container, hum)
    return path


def sound(path: Path) -> Path:
    """A film without a picture."""
    with av.open(str(path), "w") as container:
        _silence(container, container.add_stream("aac", rate=48_000))
    return path


def _silence(container: Any, stream: Any) -> None:
    frame = av.AudioFrame(format="fltp", layout="stereo", samples=1024)
    frame.sample_rate, frame.pts = 48_000, 0
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def turned(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """The same .mp4 with a, b, c, d of its display matrix (ISO/IEC 14496-12, 6.2.2)."""
    a, b, c, d = (value << 16 for value in matrix)
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + (52 if data[data.index(b"tkhd") + 4] else 40)
    data[start : start + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(data))
    return path
