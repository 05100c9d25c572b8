"""A gzip stream read piece by piece, that cannot be made to fill the memory."""

from __future__ import annotations

import zlib
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stages.formats.problems import BadFileError

# Packed splats gzip to a half or a third. What claims more than this is refused before memory is
# taken for it; little files may, for all their splats can be equal.
_RATIO_LIMIT = 100
_ALWAYS_ALLOWED_BYTES = 64 << 20
_PIECE_BYTES = 1 << 18
_EXTRA_BYTES = 1 << 20  # after the splats: extensions, which are passed over


class Inflated:
    """The content of a gzip file. Every method raises BadFileError for what is damaged."""

    def __init__(self, file: BinaryIO, size_bytes: int) -> None:
        self._file, self._size = file, size_bytes
        self._gzip = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)

    def expect(self, count: int) -> None:
        """Refuse a file that cannot honestly hold `count` bytes more."""
        if count > max(_ALWAYS_ALLOWED_BYTES, _RATIO_LIMIT * self._size):
            raise BadFileError(f"it declares {count} bytes in a file of {self._size}")

    def read(self, count: int) -> bytes:
        """Exactly `count` bytes."""
        parts: list[bytes] = []
        missing = count
        while missing:
            part = self._some(missing)
            if not part:
                raise BadFileError(f"it is cut short: {missing} bytes are missing")
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)

    def rows(self, count: int, width: int) -> NDArray[np.uint8]:
        """[count, width] bytes."""
        return np.frombuffer(self.read(count * width), np.uint8).reshape(count, width)

    def finish(self) -> None:
        """Read to the end, where gzip keeps its check sum."""
        extra = 0
        while part := self._some(_PIECE_BYTES):
            extra += len(part)
            if extra > _EXTRA_BYTES:
                raise BadFileError("it holds more than its header declares")

    def _some(self, limit: int) -> bytes:
        """At least one byte and at most `limit`; nothing at the stream's end."""
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
