"""Reads the frames of a video file in order, upright; frames that are damaged are skipped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from stages.ingest.decode import Unusable
from stages.ingest.video_colour import Colours, srgb
from stages.scene import fitted_size

# By content; formats that name other files to read are not among them.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,asf,gif,flv,ogg,h264,hevc"
)
_COPY_OR_EXPORT = "Copy it from the camera again, or export it as H.264 or HEVC"
_SMALLEST_SIDE_PX = 16
_LARGEST_SIDE_PX = 16_384
_HARDLY_ANY = 10  # damaged frames for each that decodes
_LOST_SECONDS = 1.0  # at the end: less may be rounding of the container


@dataclass
class Frame:
    """A decoded frame.

    Args:
        number: from 0, in the order shown, among those that decode.
        seconds: since the start of the video.
        picture: the PyAV frame.
        colours: what the video declares of its colours.
        aspect: width of a pixel over its height.
    """

    number: int
    seconds: float
    picture: Any
    colours: Colours
    aspect: float = 1.0

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) upright, in square pixels."""
        width, height = self._stored_size()
        return (height, width) if self._orientation()[0] else (width, height)

    def grey(self, longer_side: int) -> NDArray[np.uint8]:
        """[H, W] as stored, not upright, the longer side at most `longer_side` pixels."""
        width, height = fitted_size(*self._stored_size(), longer_side)
        small = self.picture.reformat(width, height, "gray", interpolation="AREA")
        return np.ascontiguousarray(small.to_ndarray())

    def srgb(self, longer_side: int) -> NDArray[np.uint8]:
        """[H, W, 3] upright, the longer side at most `longer_side` pixels."""
        width, height = fitted_size(*self._stored_size(), longer_side)
        pixels = srgb(self.picture, self.colours, width, height)
        transposed, columns_reversed, rows_reversed = self._orientation()
        if transposed:
            pixels = pixels.transpose(1, 0, 2)
        if columns_reversed:
            pixels = pixels[:, ::-1]
        if rows_reversed:
            pixels = pixels[::-1]
        return np.ascontiguousarray(pixels)

    def _orientation(self) -> tuple[bool, bool, bool]:
        """Whether rows and columns change places, then whether columns, and rows, are reversed,
        from the stored to the upright picture.

        The display matrix of the file (ISO/IEC 14496-12, 6.2.2) takes a stored position (p, q) to
        x = a p + c q and y = b p + d q. It may mirror a picture, which an angle does not say.
        """
        for side_data in self.picture.side_data:
            if side_data.type.name == "DISPLAYMATRIX":
                a, b, _, c, d = np.frombuffer(bytes(side_data), "<i4")[:5]
                transposed = abs(b) > abs(a)
                return transposed, (c if transposed else a) < 0, (b if transposed else d) < 0
        return False, False, False

    def _stored_size(self) -> tuple[int, int]:
        return max(1, round(self.picture.width * self.aspect)), self.picture.height


class Video:
    """A video file. It can be read several times, in memory that does not grow with its length.

    These are known after `frames` has ended:

    Args:
        path: of the file.
        decoded: how many frames decoded.
        damaged: how many packets did not.
        missing_s: seconds at the end that the file announces but does not have.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.decoded = self.damaged = 0
        self.missing_s = 0.0

    def frames(self) -> Iterator[Frame]:
        """Every frame that decodes. Raises Unusable at the end if hardly any did."""
        self.decoded = self.damaged = 0
        with _opened(self.path) as container:
            stream = _video_stream(container)
            stream.thread_type = "AUTO"
            start = stream.start_time or 0
            aspect = float(stream.sample_aspect_ratio or 1)
            last = end = 0.0
            for picture in self._decoded(container, stream):
                _check_size(picture.width, picture.height)
                colours = Colours.of(stream.codec_context)
                if picture.pts is not None:
                    last = max(last, float((picture.pts - start) * stream.time_base))
                    end = max(end, last + float((picture.duration or 0) * stream.time_base))
                yield Frame(self.decoded, last, picture, colours, aspect)
                self.decoded += 1
            whole = float(stream.duration * stream.time_base) if stream.duration else 0.0
        if _HARDLY_ANY * self.decoded <= self.damaged:  # encrypted frames may decode by chance
            raise Unusable(
                "hardly any of its frames decodes: it is encrypted, or damaged"
                if self.damaged
                else "it holds no frames",
                _COPY_OR_EXPORT,
            )
        self.missing_s = whole - end if whole - end > _LOST_SECONDS else 0.0

    def about_frames(self) -> int:
        """The number of frames that the file announces, roughly; 0 if it announces none."""
        with _opened(self.path) as container:
            stream = _video_stream(container)
            seconds = stream.duration * stream.time_base if stream.duration else 0
            return stream.frames or round(float(seconds * (stream.average_rate or 0)))

    def _decoded(self, container: Any, stream: Any) -> Iterator[Any]:
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except (av.FFmpegError, EOFError):  # the file breaks off
                self.damaged += 1
                packet = None
            if packet is None:
                return
            try:
                pictures = packet.decode()
            except (av.FFmpegError, EOFError):
                self.damaged += 1
                continue
            yield from (picture for picture in pictures if not picture.is_corrupt)


def _opened(path: Path) -> Any:
    """The PyAV container. Raises Unusable."""
    try:
        if path.stat().st_size == 0:
            raise Unusable("the file is empty", _COPY_OR_EXPORT)
        limits = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
        return av.open(str(path), options=limits, metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise Unusable(
            f"it does not open as a video ({reason}); a recording that was cut off may lack "
            "its index",
            _COPY_OR_EXPORT,
        ) from error


def _video_stream(container: Any) -> Any:
    """The first video stream that is not a cover picture. Raises Unusable."""
    cover = av.stream.Disposition.attached_pic
    streams = [s for s in container.streams.video if not s.disposition & cover]
    if not streams:
        raise Unusable("it holds no video, only sound or data", "Use a file with video")
    if streams[0].codec_context is None:
        raise Unusable("its codec is not known here", "Export it as H.264 or HEVC")
    return streams[0]


def _check_size(width: int, height: int) -> None:
    if not _SMALLEST_SIDE_PX <= min(width, height) <= max(width, height) <= _LARGEST_SIDE_PX:
        raise Unusable(f"its frames have {width} x {height} pixels", "Export it in a usual size")
