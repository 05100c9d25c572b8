"""Sinks: they receive renderings one after another and write pictures or films.

Pictures: colours in 8 bits, depth in float32. Films: H.264 in an .mp4 file that browsers, phones
and editors play.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import make_folder, replacing
from stages.base.errors import ResourceError
from stages.raster.definition import Rendering

_BT709 = 1  # ITU-T H.273: primaries, transfer and matrix have the same number
_LIMITED_RANGE = 1  # luma in 16..235, as players expect
_FFMPEG_ERRORS = 256  # FFmpeg's own error numbers start here, above the system's
_CONSTANT_QUALITY = "17"  # of x264's 0..51; differences from the pictures are hard to see

AddFrame = Callable[[NDArray[np.uint8]], None]


@contextmanager
def film(path: Path, width: int, height: int, fps: float) -> Iterator[AddFrame]:
    """Yield a function that adds a picture [H, W, 3] uint8 sRGB to the film `path`.

    The file is written whole when the block ends, or not at all. It can be played before it is
    loaded whole ("faststart"), and declares its colours as BT.709.

    Args:
        width, height: even, because 4:2:0 has one colour for each 2 x 2 pixels.
        fps: frames a second.

    Raises SplatError "film-encoder", and OSError if the file cannot be written.
    """
    import av

    if width % 2 or height % 2:
        raise ValueError(f"{width} x {height}, wanted even numbers")
    with replacing(path) as partial:
        try:
            with av.open(str(partial), "w", options={"movflags": "+faststart"}) as container:
                rate = Fraction(fps).limit_denominator(1001)
                stream = container.add_stream("libx264", rate=rate)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                stream.options = {"crf": _CONSTANT_QUALITY, "preset": "medium"}
                context = stream.codec_context
                context.color_primaries = context.color_trc = context.colorspace = _BT709
                context.color_range = _LIMITED_RANGE

                def add(picture: NDArray[np.uint8]) -> None:
                    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                    frame = frame.reformat(
                        format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG"
                    )
                    container.mux(stream.encode(frame))

                yield add
                container.mux(stream.encode(None))
        except av.FFmpegError as error:
            if error.errno != errno.EINVAL and 0 < (error.errno or 0) < _FFMPEG_ERRORS:
                raise OSError(error.errno, error.strerror) from error  # such as a full disk
            raise ResourceError(
                "film-encoder",
                given=f"The film could not be encoded: {error}.",
                wanted=f"An encoder that takes {width} x {height} pixels at {fps:g} a second.",
                hint="Choose a smaller --width, or --out a folder to get pictures.",
            ) from error


Put = Callable[[Rendering], None]


def save_rendering(path: Path, depth: bool, rendering: Rendering) -> None:
    """Write the picture `path`; with `depth` also its depth as .depth.tiff. Raises SplatError."""
    save_picture(path, eight_bits(rendering.image))
    if depth:
        floats = np.ascontiguousarray(rendering.median_depth, np.float32)
        save_picture(path.with_suffix(".depth.tiff"), floats)


@contextmanager
def folder_sink(folder: Path, frames: int, depth: bool) -> Iterator[Put]:
    """Writes frame_0001.png and so on into `folder`, which is made; existing frames are replaced.
    With `depth` also frame_0001.depth.tiff. Raises SplatError."""
    make_folder(folder)
    number = 0

    def put(rendering: Rendering) -> None:
        nonlocal number
        number += 1
        name = f"frame_{number:0{max(4, len(str(frames)))}}.png"
        save_rendering(folder / name, depth, rendering)

    yield put


def frames_beyond(folder: Path, frames: int) -> int:
    """The number of frames in `folder` that belong to an earlier, longer path."""
    numbers = (path.stem.removeprefix("frame_") for path in folder.glob("frame_*.png"))
    return sum(number.isdigit() and int(number) > frames for number in numbers)


@contextmanager
def film_sink(path: Path, width: int, height: int, fps: float) -> Iterator[Put]:
    """Writes the film `path`, whole at the end. Raises SplatError."""
    with film(path, width, height, fps) as add:
        yield lambda rendering: add(eight_bits(rendering.image))


def eight_bits(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 of a rendering's colours; NaN becomes black."""
    return np.asarray(np.rint(np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0).astype(np.uint8))


def save_picture(path: Path, pixels: NDArray[np.uint8] | NDArray[np.float32]) -> None:
    """Write colours [H, W, 3] uint8 in the format that the suffix names, or a depth [H, W] float32
    as .tiff: z in world units, 0 for the background. Raises SplatError."""
    with replacing(path) as partial:
        Image.fromarray(pixels).save(partial)
