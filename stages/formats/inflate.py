"""Reading gzip and zstd streams in pieces, with bounded memory."""

from __future__ import annotations

import zlib
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError

# Splats compress to a half or a third. A file that declares a higher ratio than this is refused
# before memory is allocated; small files may, because all their splats can be equal.
_RATIO_LIMIT = 30
_ALWAYS_ALLOWED_BYTES = 8 << 20
_PIECE_BYTES = 1 << 18
_WINDOW_BYTES = (
    1 << 27
)  # of zstd: the limit of its own decoders, which all levels of the encoder respect
_EXTRA_BYTES = 1 << 20  # after the splats: extensions, which are ignored


class GzipReader:
    """The content of a gzip file. Every method raises BadFileError for a damaged file."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._gzip = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)

    def read(self, count: int) -> bytes:
        """Exactly `count` bytes."""
        return self.rows(1, count).tobytes()

    def rows(self, count: int, width: int) -> NDArray[np.uint8]:
        """[count, width] bytes."""
        out = np.empty(count * width, np.uint8)
        filled = 0
        while filled < len(out):
            part = self._some(len(out) - filled)
            if not part:
                raise BadFileError(f"it is cut short: {len(out) - filled} bytes are missing")
            out[filled : filled + len(part)] = np.frombuffer(part, np.uint8)
            filled += len(part)
        return out.reshape(count, width)

    def finish(self) -> bytes:
        """The rest of the content, to the end of the stream, where gzip verifies its checksum."""
        extra = b""
        while part := self._some(_PIECE_BYTES):
            extra += part
            if len(extra) > _EXTRA_BYTES:
                raise BadFileError("it holds more than its header declares")
        return extra

    def _some(self, limit: int) -> bytes:
        """1 to `limit` bytes; none at the end of the stream."""
        while not self._gzip.eof:
            piece = self._gzip.unconsumed_tail or self._file.read(_PIECE_BYTES)
            try:
                out = self._gzip.decompress(piece, min(limit, _PIECE_BYTES))
            except zlib.error as error:
                raise BadFileError(f"it is damaged ({error})") from error
            if out:
                return out
            if not piece:
                raise BadFileError("it is cut short")
        return b""


def check_size(count: int, file_bytes: int) -> None:
    """Raises BadFileError if a file of `file_bytes` cannot plausibly unpack to `count` bytes."""
    if count > max(_ALWAYS_ALLOWED_BYTES, _RATIO_LIMIT * file_bytes):
        raise BadFileError(f"it declares or unpacks to {count} bytes in a file of {file_bytes}")


def read_zstd_frame(file: BinaryIO, packed_bytes: int, count: int) -> NDArray[np.uint8]:
    """[count] bytes of the zstd frame in the next `packed_bytes` of the file.

    `count` must have passed `check_size`. Raises BadFileError for a damaged frame.
    """
    import zstandard

    packed = file.read(packed_bytes) if packed_bytes <= _left(file) else b""
    if len(packed) < packed_bytes:
        raise BadFileError("it is cut short")
    out = np.empty(count, np.uint8)
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
    try:
        with unpacker.stream_reader(packed) as stream:
            filled = 0
            while filled < count and (more := stream.readinto(out[filled:].data)):
                filled += more
            if filled < count:
                raise BadFileError(f"it is cut short: {count - filled} bytes are missing")
            if count and stream.read(1):
                raise BadFileError("it holds more than its header declares")
    except zstandard.ZstdError as error:
        raise BadFileError(f"it is damaged ({error})") from error
    return out


def _left(file: BinaryIO) -> int:
    here = file.tell()
    end = file.seek(0, 2)
    file.seek(here)
    return end - here
