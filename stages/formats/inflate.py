"""Reading gzip and zstd streams in pieces, with bounded memory."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError

# Splats compress to a half or a third. A file that declares a higher ratio than this is refused
# before memory is allocated; small files may, because all their splats can be equal.
_RATIO_LIMIT = 30
_ALWAYS_ALLOWED_BYTES = 8 << 20
_WINDOW_BYTES = 1 << 27  # of zstd: the limit of its decoders, which all levels of encoders respect
_PIECE_BYTES = 1 << 18  # at a time, because gzip copies what it reads
_EXTRA_BYTES = 1 << 20  # after the splats: extensions, which are ignored


def read_rows(stream: Any, count: int, width: int) -> NDArray[np.uint8]:
    """[count, width] the next bytes of a stream. Raises BadFileError if there are fewer."""
    out = np.empty(count * width, np.uint8)
    filled = 0
    while filled < len(out) and (more := stream.readinto(out[filled : filled + _PIECE_BYTES].data)):
        filled += more
    if filled < len(out):
        raise BadFileError(f"it is cut short: {len(out) - filled} bytes are missing")
    return out.reshape(count, width)


def read_rest(stream: Any) -> bytes:
    """The rest of a stream, to its end, where gzip verifies its checksum. Raises BadFileError if
    that is more than extensions take."""
    extra: bytes = stream.read(_EXTRA_BYTES + 1)
    if len(extra) > _EXTRA_BYTES:
        raise BadFileError("it holds more than its header declares")
    return extra


def check_size(count: int, file_bytes: int) -> None:
    """Raises BadFileError if a file of `file_bytes` cannot plausibly unpack to `count` bytes."""
    if count > max(_ALWAYS_ALLOWED_BYTES, _RATIO_LIMIT * file_bytes):
        raise BadFileError(f"it declares or unpacks to {count} bytes in a file of {file_bytes}")


def read_zstd_frame(file: BinaryIO, packed_bytes: int, count: int) -> NDArray[np.uint8]:
    """[count] bytes of the zstd frame in the next `packed_bytes` of the file.

    `packed_bytes` must be at most the size of the file, and `count` must have passed `check_size`,
    because that much memory is allocated. Raises BadFileError for a damaged frame.
    """
    packed = file.read(packed_bytes)
    if len(packed) < packed_bytes:
        raise BadFileError("it is cut short")
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
    try:
        with unpacker.stream_reader(packed) as stream:
            out = read_rows(stream, count, 1).ravel()
            if count and stream.read(1):
                raise BadFileError("it holds more than its header declares")
    except zstandard.ZstdError as error:
        raise BadFileError(f"it is damaged ({error})") from error
    return out
